"""Format of a worker's log."""

import pytest

from marey_client.errors import MareyError
from marey_worker.commands import _form_named, _level_of


def test_a_worker_without_a_terminal_logs_json_unless_told_otherwise():
    assert _form_named(None) == "json"
    assert _form_named("text") == "text"


def test_a_form_or_a_level_that_is_none_is_refused_with_those_there_are():
    with pytest.raises(MareyError, match="MAREY_LOG_FORM is 'xml'; it must be json or text"):
        _form_named("xml")
    with pytest.raises(MareyError, match="MAREY_LOG_LEVEL is 'loud'; it must be debug"):
        _level_of({"MAREY_LOG_LEVEL": "loud"})
    assert (_level_of({}), _level_of({"MAREY_LOG_LEVEL": "debug"})) == ("info", "debug")

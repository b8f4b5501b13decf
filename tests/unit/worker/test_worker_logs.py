"""Format of a worker's log."""

import pytest
from tests.support.attached_worker import StartWorker
from tests.support.fake_server import FakeServer

from marey_client.errors import MareyError
from marey_worker.commands import _form_named, _level_of


def test_a_worker_without_a_terminal_logs_json_unless_told_otherwise() -> None:
    assert _form_named(None) == "json"
    assert _form_named("text") == "text"


@pytest.mark.parametrize("form", ["json", "text"])
def test_a_worker_logs_in_the_form_that_its_environment_names(
    server: FakeServer, start_worker: StartWorker, form: str
) -> None:
    worker = start_worker(env={"MAREY_LOG_FORM": form})
    server.ended(server.submit("add", {"a": 1, "b": 1}))
    assert worker.stop() == 0
    lines = worker.log.read_text().splitlines()
    assert any("works for" in line for line in lines)
    assert {line.startswith("{") for line in lines} == {form == "json"}


def test_a_form_or_a_level_that_is_none_is_refused_with_those_there_are() -> None:
    with pytest.raises(MareyError, match="MAREY_LOG_FORM is 'xml'; it must be json or text"):
        _form_named("xml")
    with pytest.raises(MareyError, match="MAREY_LOG_LEVEL is 'loud'; it must be debug"):
        _level_of({"MAREY_LOG_LEVEL": "loud"})
    assert (_level_of({}), _level_of({"MAREY_LOG_LEVEL": "debug"})) == ("info", "debug")

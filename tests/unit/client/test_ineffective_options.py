"""Options that would have no effect together with others: the command refuses them before it sends a request."""

import pytest
from tests.support.command_line import run_here


@pytest.mark.parametrize(
    ("line", "option"),
    [
        ("bench load --other-workers --work-ms 5", "--work-ms"),
        ("doctor --chaos --no-local", "--local"),
        ("login --with-token --days 3", "--days"),
        ("sample lab/models/walk --into made --format npz", "--format"),
        ("proposal merge lab/gaits 1 --withdraw --when-green", "--when-green"),
        ("token ls --everybody --user ada", "--user"),
        ("upload walk.bvh --project lab --left-handed --handedness right", "--left-handed"),
    ],
)
def test_an_option_without_effect_is_refused(line: str, option: str) -> None:
    done = run_here(line.split())
    assert done.returncode == 2
    assert option in done.stderr


def test_default_values_of_options_are_not_refused() -> None:
    done = run_here(["bench", "load", "--other-workers", "--rate", "nothing"])
    assert "--rate nothing: give numbers" in done.stderr

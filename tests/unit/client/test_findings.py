"""Results of jobs on evaluations, in the SDK and on the command line."""

import json

import httpx
import pytest
from tests.support.scripted_server import ScriptedServer, folder

from marey_client.cli.comparisons import _print_comparison, _print_several
from marey_client.cli.improvements import OPTIMISE, _print_steps
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.handles.evaluations import EvaluationHandle
from marey_schemas.encoding.digests import digest_of
from marey_schemas.items import Item

NOW = "2026-01-01T00:00:00Z"
DOCUMENT = json.dumps({"schema": "marey/suggestions@1"}).encode()


def evaluation(script: ScriptedServer, name: str) -> EvaluationHandle:
    item = Item(
        id=f"evaluation_{name}",
        kind="evaluation",
        name=name,
        collection="",
        revision=2,
        created_at=NOW,
        updated_at=NOW,
        rev=1,
    )
    return EvaluationHandle(script.marey().transport, "lab", item)


def answer(request: httpx.Request) -> httpx.Response:
    if "/blobs/" in request.url.path:
        return httpx.Response(200, content=DOCUMENT)
    job = {
        "id": "job_1", "project": "lab", "kind": "suggest", "state": "succeeded", "params": {}, "inputs": {},
        "into": "", "priority": 0, "seed": 0, "attempt": 1, "fence": 1, "max_attempts": 3, "author": "ann",
        "created_at": NOW, "run_at": NOW, "rev": 1,
        "result": {"fillings": 3, "document": {"blob": digest_of(DOCUMENT), "size_bytes": len(DOCUMENT)}},
    }  # fmt: skip
    return httpx.Response(200, json=job)


def test_suggestions_are_asked_for_by_the_revision_that_was_read_and_with_what_was_given(
    script: ScriptedServer,
) -> None:
    script.answers = [folder("others"), answer, answer, answer]
    found = evaluation(script, "first").suggest("others", removals=3)
    assert json.loads(script.requests[1].content) == {
        "kind": "suggest",
        "inputs": {
            "evaluation": {"item": "evaluation_first", "revision": 2},
            "candidates": [{"collection": "others"}],
        },
        "params": {"removals": 3},
    }
    assert found.summary == {"fillings": 3}
    assert found.document() == {"schema": "marey/suggestions@1"}
    with pytest.raises(LookupError, match="has no report"):
        found.report()


def test_a_comparison_in_which_nothing_changed_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    lists: dict[str, list[str]] = {name: [] for name in ("changed", "metrics", "removed", "added", "newly_unused")}
    _print_comparison({**lists, "trials": 162})
    assert "No trial changed: the results of all 162 trials are identical, bit for bit." in capsys.readouterr().out


@pytest.mark.parametrize(("replicates", "said"), [(1, True), (8, False)])
def test_a_change_without_interval_is_printed_with_what_is_missing(
    replicates: int, said: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    lists: dict[str, list[str]] = {name: [] for name in ("changed", "removed", "added", "newly_unused")}
    change = {"metric": "offset_mean", "before": 0.5, "after": 0.6, "change": 0.1, "low": None, "high": None,
              "verdict": "unclear", "replicates": replicates}  # fmt: skip
    _print_comparison({**lists, "metrics": [change], "trials": 162})
    assert ("--replicates 3 or more" in " ".join(capsys.readouterr().out.split())) is said


def test_several_sets_are_printed_beside_each_other_with_their_verdicts(
    script: ScriptedServer, capsys: pytest.CaptureFixture[str]
) -> None:
    def compared(after: str, offset_m: float, verdict: str) -> dict[str, object]:
        change = {"metric": "offset_mean", "before": 0.5, "after": offset_m, "verdict": verdict, "replicates": 8}
        return {"names": {"before": "union", "after": after}, "metrics": [change]}

    _print_several({**compared("walks", 0.25, "better"), "others": [compared("runs", 0.75, "worse")]})
    told = capsys.readouterr().out.splitlines()
    assert next(line.split() for line in told if "metric" in line) == ["metric", "union", "walks", "runs"]
    found = next(line.split() for line in told if "offset" in line)
    assert found == ["offset", "m", "0.5000", "0.2500", "better", "0.7500", "worse"]

    first, *others = (evaluation(script, f"set{number}") for number in range(9))
    request = first.compare_request(*others[:3])
    assert [request.inputs["after"], *request.inputs["others"]] == [one.as_input() for one in others[:3]]
    with pytest.raises(ValueError, match="between 2 and 8"):
        first.compare_request(*others)


def test_a_refused_step_is_printed_with_the_probability_by_which_it_was_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    change = {"change": -0.02, "low": -0.03, "high": -0.01, "again_low": -0.035, "again_high": -0.005, "p": 0.06}
    refused = {"action": "remove", "sources": ["a"], "estimated_gain": 0.05, "effect": {"objective": change}}
    _print_steps(
        {"names": {"a": "walk"}, "steps": [], "unconfirmed": [refused], "ended": "not confirmed", "total": None}
    )
    printed = " ".join(capsys.readouterr().out.split())
    assert "Not confirmed: remove walk seemed to change the objective by -0.0500 m; in other replicates" in printed
    assert "-0.0200 (-0.0350 to -0.0050) m. Among several candidates, chance alone changes it so much" in printed
    assert "with probability 0.06" in printed


def test_weights_of_the_objective_are_read_by_name() -> None:
    weight = next(one for one in OPTIMISE.options if one.path == ("objective",))
    assert weight.spellings == ("--objective", "--weight")
    assert weight.read(["seconds=0.001", "offset=2"]) == {"seconds": 0.001, "offset": 2.0}
    with pytest.raises(WrongUsage, match="the names are offset, "):
        weight.read(["length=1"])
    with pytest.raises(WrongUsage, match="'much' is not a number"):
        weight.read(["seconds=much"])

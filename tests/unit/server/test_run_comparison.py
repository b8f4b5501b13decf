"""Comparisons of the runs of a script: settings, replicates, best values, and results that a worker has invented."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
from scipy.stats import t
from tests.support.queue_desk import Desk

from marey_schemas.queue.comparisons import MOST_CURVE_BYTES, Curve, Curves, RunComparison
from marey_schemas.queue.scripts import ScriptCreate, ScriptRunCreate
from marey_server.errors import BadRequestProblem
from marey_server.motions.run_comparison import Compared, compare_runs
from marey_server.store import blobs
from marey_server.store.scripts import registry, runs

TRAIN: dict[str, Any] = {
    "name": "train", "repository": "https://git.invalid/motion", "commit": "a" * 40,
    "argv": ["python", "train.py", "{parameter:size}", "{output:fields}"],
    "parameters": {"size": {"type": "integer"}},
    "outputs": {"fields": {"kind": "fields", "format": "jsonl"}},
}  # fmt: skip


@pytest.fixture
def trained(desk: Desk) -> Desk:
    request = ScriptCreate.model_validate(TRAIN)
    desk.database.write(desk.user, registry.register_script, "lab", request, ("https://git.invalid/",))
    return desk


def run(desk: Desk, size: int, seed: int, result: dict[str, Any], *, curves: bytes | None = None) -> str:
    """Submit a run, and complete it with this result, and the file of its curves."""
    request = ScriptRunCreate(values={"size": size}, seed=seed)
    job = desk.database.write(desk.user, runs.run_script, "lab", "train", request).id
    lease = desk.claim(kinds=("script",))
    if curves is not None:
        digest = desk.database.write(desk.attempt(lease), blobs.put_blob, curves)
        result = {**result, "curves": {"blob": digest, "size_bytes": len(curves)}}
    desk.complete(lease, result=result)
    return job


def compared(desk: Desk, sort: str = "created_at", limit: int = 100, **wanted: Any) -> RunComparison:
    order = Compared(sort, limit, **wanted)
    return desk.database.read(desk.user, lambda tx: compare_runs(tx, "lab", "train", order))


def places(comparison: RunComparison) -> list[Sequence[int]]:
    return [setting.runs for setting in comparison.settings]


def test_replicates_have_a_mean_with_an_interval_and_each_seed_counts_once(trained: Desk) -> None:
    for size, seed, loss in ((1, 0, 4.0), (1, 1, 6.0), (2, 0, 1.0), (1, 2, 11.0), (1, 2, 5.0), (2, 1, 3.0)):
        run(trained, size, seed, {"fields": {"loss": loss, "same": "x"}})
    found = compared(trained, goals={"loss": "lowest"})
    assert places(found) == [(0, 1, 4), (2, 5)]
    assert [one.counted for one in found.runs] == [True, True, True, False, True, True]
    first, second = (setting.fields["loss"] for setting in found.settings)
    half = t.ppf(0.975, 2) * 1.0 / 3**0.5
    assert (first.n, first.mean, found.settings[0].repeats) == (3, 5.0, 1)
    assert (first.low, first.high) == pytest.approx((5.0 - half, 5.0 + half))
    assert (second.n, second.mean, second.low, second.high) == (2, 2.0, None, None)
    columns = {column.name: column for column in found.columns}
    assert {name for name, column in columns.items() if column.differs} == {"size", "loss"}
    assert (columns["loss"].best, columns["loss"].best_mean, columns["same"].numeric) == (1.0, 2.0, False)
    descending = {column.name: column for column in compared(trained, "-fields.loss", 2).columns}["loss"]
    assert (descending.goal, descending.best) == ("highest", 11.0)
    assert not compared(trained, limit=2).complete
    with pytest.raises(BadRequestProblem, match="the fields are loss, same"):
        compared(trained, fields=("other",))
    with pytest.raises(BadRequestProblem, match="cannot be sorted"):
        compared(trained, "loss")


def test_a_setting_has_no_mean_if_a_replicate_gave_no_number(trained: Desk) -> None:
    for seed, loss in enumerate((1.0, "NaN", 2.0)):
        run(trained, 1, seed, {"fields": {"loss": loss}})
    assert compared(trained).settings[0].fields == {}


def test_curves_are_read_only_if_they_are_curves(trained: Desk) -> None:
    curve = Curve(steps=(0, 1), values=(1.5, None), logged=2)
    content = Curves(curves={"loss": curve, "other": curve}).model_dump_json().encode()
    unsound = (
        '{"loss": {"steps": [1], "values": [], "logged": 1}}',
        '{"loss": {"steps": [1], "values": [1e999], "logged": 1}}',
        '{"loss": {"steps": [2, 1], "values": [1, 2], "logged": 2}}',
        '{"loss": {"steps": [1], "values": [1], "logged": -1}}',
        '{"' + "n" * 64 + '": {"steps": [1], "values": [1], "logged": 1}}',
    )
    files = [content, b" " * MOST_CURVE_BYTES + content, *(f'{{"curves": {one}}}'.encode() for one in unsound)]
    for seed, file in enumerate(files):
        run(trained, 1, seed, {"fields": {"loss": 1}}, curves=file)
    for made_up in ({"size_bytes": 1}, [1], "text", {"blob": 7}):
        run(trained, 1, 9, {"fields": {"loss": 1}, "curves": made_up})
    found = compared(trained, curves=True, fields=("loss",))
    assert found.curves == ("loss",)
    assert [one.curves for one in found.runs] == [{"loss": curve}, *[{}] * 10]
    assert compared(trained, curves=True).curves == ("loss", "other")
    assert compared(trained).curves == ()


def test_results_that_a_worker_made_up_give_a_comparison_of_what_is_sound(trained: Desk) -> None:
    huge = {"big": 10**400, "many": "x" * 501, "n" * 64: 1, "list": [1], "largest": 1.7e308, "b": True}
    for seed in range(3):
        run(trained, 10**30, seed, {"fields": {**huge, "<b>": "<script>"}})
    run(trained, 2, 0, {"fields": "text"})
    run(trained, 2, 0, {})
    found = compared(trained)
    assert found.runs[0].fields == {"largest": 1.7e308, "b": True, "<b>": "<script>"}
    assert found.settings[0].fields["largest"].mean == 1.7e308
    assert RunComparison.model_validate_json(found.model_dump_json()) == found
    many = {f"f{number}": number for number in range(30)}
    run(trained, 3, 0, {"fields": {"\x1b]0;title": 1, **many}})
    with pytest.raises(BadRequestProblem, match=r"the fields are .*, f0, .*f17 and 12 more\.$") as refused:
        compared(trained, fields=("unknown",))
    assert refused.value.detail.isprintable()

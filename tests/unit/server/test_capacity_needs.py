"""Computed capacity: needs of an amount of work, and files of measured costs."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from tests.support.command_line import run_here

from marey_server.capacity.answers import NotComputable, capacity, fit_idle, predict
from marey_server.capacity.costs import MEASURED, JobCosts, MeasuredCosts
from marey_server.capacity.needs import PlannedWork, compute_needs
from marey_server.store.jobs.policy import DEFAULT_POLICY

COSTS = MeasuredCosts.model_validate(
    {
        "date": "2026-01-01", "machine": "test", "load": "idle",
        "job": {"claim_s": 0.002, "complete_s": 0.003, "busy_s": 0.004, "database_s": 0.01, "database_bytes": 1000},
        "clip": {"frames": 100, "stored_bytes": 2000, "import_s": 0.5, "worker_s": 2.0},
        "byte": {"upload_s": 1e-6},
    }
)  # fmt: skip
DAY = PlannedWork(clips=1000, clip_bytes=1000, days=1, workers=2, servers=3, database_processors=4)


def test_needs_are_those_of_a_computation_by_hand() -> None:
    needs = compute_needs(COSTS, DAY)
    seconds = {part.name: (part.needed_s, part.available_s) for part in needs.parts}
    beats = 1000 * 2.0 / DEFAULT_POLICY.heartbeat_s
    assert seconds["workers"] == pytest.approx((1000 * 2.005, 2 * 86400))
    assert seconds["servers"] == pytest.approx((1000 * 0.004 + beats * 0.002 + 1000 * (0.5 + 1e-3), 3 * 86400))
    assert seconds["database"] == pytest.approx(((2000 + beats / 2) * 0.01, 4 * 86400))
    assert needs.first.name == "workers"
    assert needs.clips_per_day == pytest.approx(2 * 86400 / 2.005)
    assert needs.blob_bytes == 1000 * (2 * 2000 + 1000)
    assert needs.database_bytes == 1000 * 1000


@pytest.mark.parametrize(
    ("change", "first"),
    [({"workers": 1}, "workers"), ({"workers": 10_000, "servers": 1}, "servers"),
     ({"workers": 10_000, "servers": 1000, "database_processors": 1}, "database")],
)  # fmt: skip
def test_the_part_that_saturates_first_depends_on_the_machines(change: dict[str, int], first: str) -> None:
    assert compute_needs(COSTS, replace(DAY, **change)).first.name == first


def test_at_the_computed_clips_per_day_the_first_part_is_just_saturated() -> None:
    most = compute_needs(COSTS, DAY).clips_per_day
    assert compute_needs(COSTS, replace(DAY, clips=round(most))).first.share == pytest.approx(1.0, rel=1e-4)


def test_the_installed_costs_are_valid_and_name_their_machine() -> None:
    costs = MeasuredCosts.read()
    assert costs.date
    assert "2 cores" in costs.machine


def test_costs_of_requests_and_commits_follow_from_few_and_many_workers() -> None:
    queue = COSTS.job.in_queue()
    requests_s = queue.claim.busy_s + queue.complete.busy_s
    assert requests_s + 2 * queue.batch_s == pytest.approx(0.005)
    assert requests_s + 2 * queue.batch_s * 2 / 16 == pytest.approx(0.004)
    slow = JobCosts(claim_s=0.002, complete_s=0.003, busy_s=1.0, database_s=0, database_bytes=0).in_queue()
    assert slow.batch_s == 0.0
    assert slow.claim.busy_s + slow.complete.busy_s == pytest.approx(1.0)


def test_predictions_grow_with_the_workers_until_the_server_is_saturated() -> None:
    found = predict(COSTS.job.model_dump(), (1, 8, 16, 32), 0.0)
    assert found[1] == pytest.approx(1 / 0.005, rel=0.01)
    assert found[16] == pytest.approx(1 / 0.004, rel=0.02)
    assert found[1] < found[8] < found[16] < found[32] < 1.05 / 0.004
    slow = predict(COSTS.job.model_dump(), (2, 8), 0.1)
    assert slow[2] == pytest.approx(2 / 0.105, rel=0.03)
    assert slow[8] == pytest.approx(8 / 0.105, rel=0.03)


@pytest.mark.parametrize(
    ("text", "said"),
    [("[job", "Expected"), ("", "date"), (MEASURED.read_text().replace("import_s", "imports"), "clip"),
     (MEASURED.read_text().replace("claim_s = ", "claim_s = -"), "job.claim_s")],
)  # fmt: skip
def test_a_wrong_file_of_costs_is_refused_with_the_place(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "costs.toml"
    path.write_text(text)
    with pytest.raises(NotComputable, match=said) as caught:
        capacity(costs=path)
    assert str(path) in str(caught.value)
    with pytest.raises(NotComputable, match="none"):
        capacity(costs=tmp_path / "none.toml")


def test_the_idle_share_is_found_from_a_third_number_of_workers() -> None:
    true = COSTS.job.model_dump() | {"idle": 0.4, "busy_s": 0.002}
    found = fit_idle(true | {"idle": 0.0}, 4, predict(true, (4,), 0.0)[4], 0.0)
    assert found["idle"] == pytest.approx(0.4, abs=0.05)


def test_wrong_costs_of_a_prediction_are_refused() -> None:
    with pytest.raises(NotComputable, match="busy_s"):
        predict(COSTS.job.model_dump() | {"busy_s": 0.0}, (2,), 0.0)


def test_the_command_prints_the_part_that_saturates_first() -> None:
    shown = run_here(["capacity", "--clips", "1000000", "--workers", "1"])
    assert shown.returncode == 0, shown.stderr
    assert "saturates first" in shown.stdout
    assert "workers" in shown.stdout
    found = json.loads(run_here(["capacity", "--workers", "1", "--json"]).stdout)
    assert found["first"] == "workers"
    assert set(found["predicted_jobs_per_s"]) == {"2", "8", "32"}


@pytest.mark.parametrize(
    "option", ["--days=inf", "--clip-bytes=inf", "--jobs-per-clip=1e308", "--workers=1" + "0" * 400]
)
def test_amounts_without_end_are_refused(option: str) -> None:
    shown = run_here(["capacity", option])
    assert (shown.returncode, "Invalid value" in shown.stderr) == (2, True), shown.stderr

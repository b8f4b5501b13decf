"""Workers that are killed at random moments during a pipeline from takes to a model: the results are the same bytes."""

from __future__ import annotations

import random
import secrets
from pathlib import Path
from typing import Any

import pytest
from benchmarks.pipeline_under_fire import run_pipeline, write_takes

# test_pipeline_deaths.py kills at each chosen place, and test_endurance.py at random, in the tier `test`.
pytestmark = [pytest.mark.soak, pytest.mark.timeout(600)]

WALKS = 6
STEPS_OF_WALKS: dict[str, Any] = {
    "annotate": {"proposal": {"method": "steps"}},
    "cut": {"labels": ["step_left"]},
    "align": {"rate_hz": 30},
    "model": {"leave_one_out": False, "folds": 0, "report_samples": 20},
    "tree": {"samples": 500},
}


def test_a_pipeline_whose_worker_is_killed_ends_in_the_same_bytes_with_one_worker_and_with_two(
    tmp_path: Path, database_url: str
) -> None:
    seed = secrets.randbelow(2**32)
    print(f"workers are killed with the seed {seed}")  # shown when the test fails
    material = tmp_path / "material"
    write_takes(material, WALKS, seconds=2.0)
    alone = run_pipeline(material, tmp_path / "alone" / "data", **STEPS_OF_WALKS)
    chance, on_it = random.Random(seed), {"MAREY_DATABASE_URL": database_url}
    fired = run_pipeline(
        material, tmp_path / "fired" / "data", workers=2, kills=3, chance=chance, settings=on_it, **STEPS_OF_WALKS
    )
    assert len(alone.digests) > 20
    assert {place.partition("/")[2].partition("/")[0] for place in alone.digests} >= {"aligned", "walk"}
    assert fired.digests == alone.digests, fired.moments
    assert alone.lost == 0
    assert fired.attempts > fired.lost
    assert fired.attempts - fired.lost == alone.attempts

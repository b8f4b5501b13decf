"""The example of docs/how-to/record-what-is-missing.md, which is run unchanged."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.rest_server import Server, server

from marey_client import Marey
from marey_motion.documents import mapping_to_document, skeleton_to_document
from marey_motion.gait import generate_gait
from marey_motion.rigs import guess_axes, map_joints
from marey_schemas.kinds import Kind

__all__ = ["server"]

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "record-what-is-missing.md"


def as_tree(document: Any) -> dict[str, Any]:
    return dict(document.model_dump(mode="json", by_alias=True))


def test_the_example_runs_as_it_is_written(server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    take = generate_gait(1.5, math.radians(50.0), 4.0)
    mapping = map_joints(take.skeleton)
    found = np.zeros((1, 2))
    measured = {
        "options": {"grid": {"speeds_m_s": [1.5], "turn_rates_deg_s": [-50.0, 50.0]}, "coverage_least_s": 2.0},
        "coverage": {"seconds": found},
    }
    with Marey(server.address, server.make_project()) as marey:
        lab = marey.project("lab")
        parts = {
            "hierarchy": as_tree(skeleton_to_document(take.skeleton)),
            "mapping": as_tree(mapping_to_document(mapping, guess_axes(take.skeleton, mapping))),
        }
        skeleton = lab.items(Kind.SKELETON).create("body", parts)
        evaluation = lab.evaluations.create(
            "walks-eval",
            {"evaluation": {"schema": "marey/evaluation@1", "verdict": "Bad.", "headline": {}, **measured}},
        )
        drawn: list[Any] = []
        names: dict[str, Any] = {
            "marey": marey, "skeleton_id": skeleton.id, "evaluation_id": evaluation.id,
            "capture": np.array_split(take.poses, 24), "draw": drawn.append,
        }  # fmt: skip
        exec(example, names)
        state = names["stream"].read()
    assert state.index == 0.5
    assert state.seconds[0][1] == pytest.approx((take.frame_count - 60) / 60)
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "0% covered, 4.0 s missing"
    assert told[-2] == "50% covered, 2.0 s missing"
    assert told[-1] == "  1.5 m/s, -50 degrees/s: 2.0 s"
    assert all(path[0] == (0.0, 0.0, 0.0) for path in drawn)

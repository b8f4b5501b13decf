"""Recognition of locomotion clips in the demonstration."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from marey_client.cli.demo.evaluation import DemoEvaluation, travels
from marey_client.handles.clips import ClipHandle
from marey_motion.arrays import Floats

RATE_HZ = 30.0


def clip(path_m: Floats) -> ClipHandle:
    """Return a clip whose root moves along `path_m` (frames, 3)."""
    translations = np.asarray(path_m, dtype=np.float32)
    summary = {"frames": len(translations), "frame_rate_hz": RATE_HZ}
    motion = SimpleNamespace(root_translations=translations)
    return cast(ClipHandle, SimpleNamespace(item=SimpleNamespace(summary=summary), motion=lambda joints: motion))


def walk(speed_m_s: float, seconds: float) -> Floats:
    path = np.zeros((round(seconds * RATE_HZ), 3))
    path[:, 2] = speed_m_s * np.arange(len(path)) / RATE_HZ
    return path


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        (walk(1.2, 4.0), True),
        (walk(0.3, 4.0), False),
        (walk(1.2, 0.9), False),
        (np.concatenate([walk(1.2, 3.0), np.tile(walk(1.2, 3.0)[-1], (30, 1))]), True),
        (np.concatenate([walk(1.2, 1.5), np.tile(walk(1.2, 1.5)[-1], (200, 1))]), False),
        (np.random.default_rng(1).normal(0, 0.05, (300, 3)), False),
        (walk(1.2, 4.0)[:, [0, 2, 1]], False),
    ],
    ids=["walk", "shuffle", "too short", "walk and stop", "mostly standing", "jitter", "rising"],
)
def test_locomotion_is_what_covers_ground_most_of_the_time(path: Floats, expected: bool) -> None:
    assert travels(clip(path), "hips") is expected


def test_it_is_said_where_there_was_nothing_to_evaluate() -> None:
    nothing = DemoEvaluation(clips=7, chosen=0)
    assert "None of 7 retargeted clips is locomotion" in nothing.sentence

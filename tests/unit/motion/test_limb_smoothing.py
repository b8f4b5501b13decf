"""Constraints that a limb cannot follow: the wrist passes around the shoulder and takes time, with a warning."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marey_motion.clip import Clip
from marey_motion.editing.limb_smoothing import allowed_steps, largest_steps
from marey_motion.editing.registry import EditedClip, edit_clip
from marey_motion.errors import EditError
from marey_motion.formats import read_motion
from marey_motion.gait import generate_gait
from marey_motion.motion import Motion
from marey_motion.rigs import map_joints
from marey_schemas.editing.edits import EditDocument

WALK = "bandai-namco-1/dataset-1_walk_happy_001.bvh"
ARM = ("left_shoulder", "left_elbow", "left_wrist")
BLEND_S = 0.3


@pytest.fixture(scope="module", params=["generated", "captured"])
def walk(request: pytest.FixtureRequest) -> Clip:
    if request.param == "generated":
        return generate_gait(1.2, 0.0, 3.0)
    clip = read_motion((request.getfixturevalue("mocap") / WALK).read_bytes(), Path(WALK).name).clip
    assert clip is not None
    return clip


def _constrained(clip: Clip, *constraints: dict[str, Any], **options: Any) -> EditedClip:
    document = {"commands": [{"command": "constrain", "constraints": list(constraints), **options}]}
    (made,) = edit_clip(clip, EditDocument.model_validate(document).commands)
    return made


def _warnings(made: EditedClip) -> list[str]:
    return [str(one.values["warning"]) for one in made.findings if "warning" in one.values]


def _arm(clip: Clip) -> np.ndarray:
    """Return the positions (F, 3, 3) of shoulder, elbow and wrist."""
    joints = [clip.skeleton.index_of(map_joints(clip.skeleton).joints[name]) for name in ARM]
    return np.asarray(Motion.of(clip).positions(clip.skeleton)[:, joints], dtype=np.float64)


def _excess(before: np.ndarray, after: np.ndarray, rate_hz: float) -> float:
    """Return the greatest difference, over all joints, of the largest step and the allowed step, in metres."""
    moved = np.linalg.norm(after - before, axis=-1).max(axis=0)
    steps = np.linalg.norm(np.diff(after, axis=0), axis=-1).max(axis=0)
    return float((steps - allowed_steps(largest_steps(before), moved, BLEND_S * rate_hz)).max())


@pytest.mark.parametrize("beside", [(0.0, 0.0, 0.0), (0.03, 0.02, 0.03)], ids=["at the shoulder", "beside it"])
def test_an_elbow_does_not_jump_where_the_target_passes_the_shoulder(
    walk: Clip, beside: tuple[float, float, float]
) -> None:
    before, middle, half = _arm(walk), walk.frame_count // 2, int(walk.frame_rate_hz / 3)
    target = before[middle, 0] + beside
    window = [middle - half, middle + half]
    asked = {"kind": "position", "joint": "left_wrist", "frames": window, "point_m": target.tolist()}

    made = _constrained(walk, asked)

    after = _arm(made.clip)
    assert _excess(before, after, walk.frame_rate_hz) < 0.01
    elbow_m_s = np.linalg.norm(np.diff(after[:, 1], axis=0), axis=1).max() * walk.frame_rate_hz
    assert elbow_m_s < 6.0, "an elbow that jumps by 40 cm in a frame of these clips moves at 12 to 34 m/s"
    missed = np.linalg.norm(after[slice(*window), 2] - target, axis=1)
    assert missed.max() < 0.3
    (warning,) = (one for one in _warnings(made) if "is missed" in one)
    assert f"by up to {100 * missed.max():.1f} cm in frame {window[0] + int(np.argmax(missed))}" in warning
    undamped = _arm(_constrained(walk, asked, stretch_damping_deg=0.0).clip)
    assert np.abs(undamped - after).max() > 0.05, "without damping, the limb meets the target and jumps"


def test_a_wrist_takes_time_between_two_targets_that_follow_each_other(walk: Clip) -> None:
    before, middle, half = _arm(walk), walk.frame_count // 2, int(walk.frame_rate_hz / 3)
    apart = max(0.17, 2.0 * float(largest_steps(before)[2]))
    places = [before[middle, 2] + (0.0, 0.05, 0.0), before[middle, 2] + (0.0, 0.05 + 0.6 * apart, 0.8 * apart)]
    windows = [[middle - half, middle], [middle, middle + half]]
    asked = [
        {"kind": "position", "joint": "left_wrist", "frames": window, "point_m": place.tolist()}
        for window, place in zip(windows, places, strict=True)
    ]

    made = _constrained(walk, *asked)

    after = _arm(made.clip)
    assert _excess(before, after, walk.frame_rate_hz) < 0.01
    (warning,) = (one for one in _warnings(made) if "follow each other" in one)
    assert warning.startswith(
        f"constraints[0] and constraints[1] follow each other too closely: their targets are {100 * apart:.1f} cm"
    )
    sudden = _constrained(walk, *asked, blend_s=0.0)
    assert any(f"jumps between the frames {middle - 1} and {middle};" in one for one in _warnings(sudden))
    assert np.linalg.norm(np.diff(_arm(sudden.clip)[:, 2], axis=0), axis=1).max() > 0.7 * apart
    near = [asked[0], {**asked[1], "point_m": (places[0] + (0.0, 0.001, 0.0)).tolist()}]
    assert not any("follow each other" in one for one in _warnings(_constrained(walk, *near)))


def test_a_short_window_between_two_others_keeps_a_frame() -> None:
    walk = generate_gait(1.2, 0.0, 2.0)
    at_first = _arm(walk)[60, 2]
    asked = [
        {
            "kind": "position", "joint": "left_wrist", "frames": [start, start + 10],
            "point_m": [*at_first[:2].tolist(), float(at_first[2]) + 0.7 * number],
        }
        for number, start in enumerate((60, 70, 80))
    ]  # fmt: skip
    warnings = _warnings(_constrained(walk, *asked))
    assert sum("follow each other too closely" in one for one in warnings) == 2


@pytest.mark.parametrize(
    "idle",
    [
        {"joint": "Hips", "point_m": [0.0, 1.0, 0.0]},
        {"joint": "left_wrist", "top": "left_wrist"},
    ],
    ids=["the root", "a chain without a lever"],
)
def test_a_constraint_that_cannot_act_is_refused(idle: dict[str, Any]) -> None:
    clip = generate_gait(1.2, 0.0, 1.0)
    other = {"kind": "position", "joint": "left_wrist", "frames": [10, 20]}
    with pytest.raises(EditError, match="so this position constraint has no effect") as refused:
        _constrained(clip, other, {"kind": "position", **idle})
    assert refused.value.code == "constraint-idle"
    assert "constraints[1]" in str(refused.value.where)
    moved = _constrained(clip, {"kind": "position", **idle, "offset_m": [0.0, 0.2, 0.0]})
    assert not np.array_equal(moved.clip.poses, clip.poses)

"""Edited motion: feet keep their contacts and stay above the floor, and unsuitable parameters give a warning."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.edited_takes import make_walk, under_static_root

from marey_motion.clip import Clip
from marey_motion.editing import kept_feet
from marey_motion.editing.ground import estimate_sole, heights_of_soles
from marey_motion.editing.kept_feet import SUNK_M, feet_as_motion, feet_of, with_feet
from marey_motion.editing.registry import EditedClip, edit_clip
from marey_motion.editing.take import EditedBody, Take
from marey_motion.formats import read_motion
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.rigs import map_joints
from marey_schemas.editing.edits import EditDocument

RUN = "bandai-namco-2/dataset-2_run_masculine_001.bvh"
FLOOR_M = 0.02
"""Height of the lowest joint of the standing generated body."""


def _edited(clip: Clip, command: dict[str, Any], **sources: Clip) -> EditedClip:
    (made,) = edit_clip(clip, EditDocument.model_validate({"commands": [command]}).commands, sources=sources)
    return made


def _take_of(clip: Clip) -> Take:
    return Take(Motion.of(clip), clip.frame_rate_hz, EditedBody(clip.skeleton))


def _soles(clip: Clip) -> np.ndarray:
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    return heights_of_soles(clip.skeleton, Motion.of(clip), body.feet)


def _joined(first: Clip, second: Clip, **options: Any) -> EditedClip:
    return _edited(first, {"command": "concatenate", "source": "other", **options}, other=second)


@pytest.mark.parametrize(("start", "blend"), [(82, "inertialise"), (97, "slerp"), (110, "inertialise"), (110, "slerp")])
def test_no_foot_sinks_at_a_seam_of_walks_that_are_out_of_step(start: int, blend: str) -> None:
    walk = generate_gait(1.3, 0.0, 4.0)
    first, second = walk.sliced(0, 100), walk.sliced(start, 240)
    assert _soles(_joined(first, second, blend=blend).clip).min() > FLOOR_M - 1e-3
    if start == 110:
        assert _soles(_joined(first, second, blend=blend, keep_feet=False).clip).min() < FLOOR_M - 0.03
    if blend == "slerp":
        under = _joined(under_static_root(first), under_static_root(second), blend=blend)
        assert _soles(under.clip).min() > FLOOR_M - 1e-3


def test_a_foot_that_stands_on_both_sides_of_a_seam_stays_where_it_stands() -> None:
    """The second clip is shifted sideways by 6 cm; its feet stay at their places in the first clip until they step."""
    walk = generate_gait(1.3, 0.0, 4.0)
    toe = walk.skeleton.index_of(map_joints(walk.skeleton).joints["left_toe"])
    heights, places = _soles(walk)[:, 0], Motion.of(walk).positions(walk.skeleton)[:, toe]
    still = np.linalg.norm(np.diff(places, axis=0), axis=1) < 1e-3
    seam = next(f for f in range(90, 160) if still[f - 8 : f + 8].all() and heights[f] < FLOOR_M + 0.02)
    second = _edited(walk.sliced(seam, 240), {"command": "translate", "shift_m": [0.06, 0.0, 0.0]}).clip

    def slide(*, keep_feet: bool) -> float:
        joined = _joined(walk.sliced(0, seam), second, place="keep", keep_feet=keep_feet).clip
        return float(np.ptp(Motion.of(joined).positions(joined.skeleton)[seam - 8 : seam + 6, toe, 0]))

    free, kept = slide(keep_feet=False), slide(keep_feet=True)
    assert free > 0.008
    assert kept < 0.3 * free


def test_smoothing_lowers_no_foot_and_keeps_the_ends_and_what_it_is_not_asked_for() -> None:
    walk = generate_gait(1.3, 0.0, 4.0)
    wide = {"command": "smooth", "method": "gaussian", "window_s": 0.5}
    assert _soles(_edited(walk, {**wide, "keep_feet": False}).clip).min() < FLOOR_M - 0.008
    kept = _edited(walk, wide).clip
    assert _soles(kept).min() > FLOOR_M - 1e-3
    assert np.abs(kept.poses[[0, -1]] - walk.poses[[0, -1]]).max() < 1e-6
    arms = {**wide, "joints": ["LeftArm"], "root_translation": False}
    assert np.array_equal(_edited(walk, arms).clip.poses, _edited(walk, {**arms, "keep_feet": False}).clip.poses)


def test_feet_in_place_are_lifted_to_a_floor_above_their_soles() -> None:
    walk = make_walk(seconds=0.5)
    take = _take_of(walk)
    feet, motion, soles = feet_of(take), Motion.of(walk), _soles(walk)
    floors = np.full_like(soles, 0.05)
    floors[:10] = 0.0
    made = with_feet(take, motion, feet, feet_as_motion(walk.skeleton, motion, feet), floors, slice(None))
    lifted = heights_of_soles(walk.skeleton, made, [foot.leg.end for foot in feet])
    assert soles[10:].min() < FLOOR_M + 1e-3
    assert lifted[10:].min() > 0.05 - SUNK_M
    assert np.array_equal(made.rotations[:10], motion.rotations[:10])


def test_the_last_lift_of_feet_is_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_feet, "MOST_LIFTS", 1)
    walk = make_walk(seconds=0.5)
    take = _take_of(walk)
    feet, motion = feet_of(take), Motion.of(walk)
    wanted = feet_as_motion(walk.skeleton, motion, feet)
    wanted.translations[..., 1] += 0.01
    made = with_feet(take, motion, feet, wanted, np.full_like(_soles(walk), 0.05), slice(None))
    lifted = heights_of_soles(walk.skeleton, made, [foot.leg.end for foot in feet])
    assert lifted.min() > 0.05 - 1e-3


def test_soles_come_to_the_ground_and_not_joints() -> None:
    walk = make_walk()
    lifted = _edited(walk, {"command": "translate", "shift_m": [0.0, 0.4, 0.0]}).clip
    for sole_m in (0.0, 0.02, None):
        made = _edited(lifted, {"command": "move_to_ground", "sole_m": sole_m})
        used = made.findings[0].values["sole_m"]
        assert np.median(_soles(made.clip).min(axis=1)) == pytest.approx(used, abs=0.004)
    body = MatchingBody.from_mapping(walk.skeleton, map_joints(walk.skeleton))
    assert used == estimate_sole(walk.skeleton, body)
    assert 0.03 < used < 0.05


def test_parameters_that_do_not_suit_the_motion_give_a_warning() -> None:
    walk = make_walk(seconds=2.0)

    def warnings(command: dict[str, Any], **sources: Clip) -> list[str]:
        return [
            str(one.values["warning"]) for one in _edited(walk, command, **sources).findings if "warning" in one.values
        ]

    places = [
        {"kind": "position", "joint": "left_wrist", "frames": [10, 40], "point_m": [0.3, y, 0.2]} for y in (1, 1.4)
    ]
    told = warnings({"command": "constrain", "constraints": places})
    assert told[0].startswith("constraints[0] and constraints[1] contradict each other in the frames 10:40")
    told = warnings({"command": "constrain", "constraints": [places[0], {**places[1], "frames": [70, 90]}]})
    assert not any("constraints[0] and constraints[1]" in one for one in told)
    told = warnings({"command": "constrain", "constraints": [places[0], places[0]]})
    assert not any("contradict" in one for one in told)
    shifted = [
        {"kind": "position", "joint": "left_wrist", "frames": frames, "shift_m": [0.0, 0.05, 0.0]}
        for frames in ([0, 60], [30, 90])
    ]
    assert not warnings({"command": "constrain", "constraints": shifted})
    told = warnings({"command": "constrain", "constraints": [shifted[0], {**shifted[1], "shift_m": [0.0, 0.1, 0.0]}]})
    assert "contradict each other in the frames 30:60" in told[0]
    told = warnings({"command": "constrain", "constraints": places[:1], "blend_s": 60.0})
    assert "the blend of 60 s is longer than the clip" in told[-1]
    (smoothed,) = warnings({"command": "smooth", "window_s": 30.0})
    assert "the window of 30 s is longer than the clip" in smoothed
    told = warnings({"command": "concatenate", "source": "other", "blend_s": 30.0}, other=walk)
    assert "longer than one of the two clips" in told[0]


def test_contacts_of_one_foot_that_overlap_are_refused() -> None:
    def planted(*contacts: tuple[str, int, int | None]) -> None:
        asked = [{"foot": foot, "frames": [start, stop]} for foot, start, stop in contacts]
        EditDocument.model_validate({"commands": [{"command": "plant_feet", "contacts": asked}]})

    planted(("left", 10, 30), ("right", 20, 40), ("left", 30, 50))
    with pytest.raises(ValidationError, match="two contacts of the left foot overlap at frame 29"):
        planted(("left", 29, 50), ("left", 10, 30))
    with pytest.raises(ValidationError, match="two contacts of the right foot overlap"):
        planted(("right", 0, None), ("right", 10, 30))


def test_a_knee_does_not_jump_in_a_long_blend(mocap: Path) -> None:
    """The first part of a run is followed by the whole run, out of step, with a blend of three seconds."""
    clip = read_motion((mocap / RUN).read_bytes(), "run.bvh").clip
    assert clip is not None
    seam, knee = clip.frame_count * 2 // 5, clip.skeleton.index_of(map_joints(clip.skeleton).joints["left_knee"])

    def fastest(made: Clip) -> float:
        places = Motion.of(made).positions(made.skeleton)[:, knee]
        return float(np.linalg.norm(np.diff(places, axis=0), axis=1).max())

    joined = _joined(clip.sliced(0, seam), clip, blend_s=3.0).clip
    assert fastest(joined) < 1.8 * fastest(clip)

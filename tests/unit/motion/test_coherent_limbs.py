"""Limbs that meet constraints move smoothly from frame to frame."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from marey_motion import kinematics, quaternions
from marey_motion.clip import Clip
from marey_motion.editing.inverse_kinematics.limbs import limb_ending_at
from marey_motion.editing.inverse_kinematics.solving import SolvedPoses, solve
from marey_motion.editing.inverse_kinematics.targets import Freedom, Neighbours, PositionTarget
from marey_motion.editing.registry import apply_edit, edit_clip
from marey_motion.errors import EditError
from marey_motion.gait import generate_gait
from marey_motion.gait.skeletons import game_skeleton, studio_skeleton
from marey_motion.motion import Motion
from marey_motion.rigs import guess_axes, map_joints
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.edits import EditDocument

FRAMES = 40


def _index(skeleton: Skeleton, standard: str) -> int:
    return skeleton.index_of(map_joints(skeleton).joints[standard])


def _constrained(clip: Clip, *constraints: dict[str, Any], **options: Any) -> Clip:
    document = {"commands": [{"command": "constrain", "constraints": list(constraints), **options}]}
    return apply_edit(clip, EditDocument.model_validate(document).commands)


def _resting(skeleton: Skeleton) -> Motion:
    rotations = np.tile(skeleton.rest_rotations, (FRAMES, 1, 1)).astype(np.float64)
    return Motion(np.zeros((FRAMES, 3)), rotations, np.zeros((FRAMES, 0, 3)), ())


def _across(skeleton: Skeleton) -> tuple[Motion, PositionTarget, tuple[int, int]]:
    """Return a body at rest, a wrist target that passes the direction opposite to the arm, and shoulder and elbow."""
    motion = _resting(skeleton)
    shoulder, elbow, wrist = (_index(skeleton, f"right_{part}") for part in ("shoulder", "elbow", "wrist"))
    places = motion.positions(skeleton)[0]
    arm = places[wrist] - places[shoulder]
    side = np.cross(arm, (0.3, 1.0, 0.2))
    side *= np.linalg.norm(arm) / np.linalg.norm(side)
    along, aside = np.linspace(-0.3, 0.3, FRAMES), np.full(FRAMES, 0.02)
    up = np.cross(side, arm) / np.linalg.norm(arm)
    path = -0.6 * arm + along[:, None] * side + aside[:, None] * up
    return motion, PositionTarget(wrist, places[shoulder] + path), (shoulder, elbow)


def _fastest_turn(motion: Motion, joint: int) -> float:
    q = motion.rotations[:, joint]
    return float(np.degrees(2.0 * np.arccos(np.minimum(np.abs(np.sum(q[1:] * q[:-1], axis=-1)), 1.0))).max())


@pytest.mark.parametrize("solver", ["two_bone", "least_squares", "ccd"])
def test_an_elbow_does_not_flip_where_the_target_passes_opposite_the_arm(solver: Any) -> None:
    skeleton = studio_skeleton()
    motion, target, (shoulder, _) = _across(skeleton)
    limb = limb_ending_at(skeleton, map_joints(skeleton), target.joint, None)
    assert limb is not None

    def solved(neighbours: Neighbours | None) -> SolvedPoses:
        freedom = Freedom(limb.joints)
        return solve(skeleton, motion, [target], limb=limb, freedom=freedom, solver=solver, neighbours=neighbours)

    alone, together = solved(None), solved(Neighbours(np.arange(FRAMES), 9.0))
    assert _fastest_turn(alone.motion, shoulder) > 25.0
    assert _fastest_turn(together.motion, shoulder) < 0.6 * _fastest_turn(alone.motion, shoulder)
    assert together.residual_after.max() < max(2e-4, 1.01 * alone.residual_after.max())
    apart = solved(Neighbours(2 * np.arange(FRAMES), 9.0))  # no frame has a neighbour
    assert np.array_equal(apart.motion.rotations, alone.motion.rotations)


def test_a_limb_that_moves_smoothly_alone_keeps_its_bits() -> None:
    clip = generate_gait(1.2, 0.1, 2.0)
    skeleton, motion = clip.skeleton, Motion.of(clip)
    wrist = _index(skeleton, "left_wrist")
    limb = limb_ending_at(skeleton, map_joints(skeleton), wrist, guess_axes(skeleton, map_joints(skeleton)))
    assert limb is not None
    target = [PositionTarget(wrist, motion.positions(skeleton)[:, wrist] + (0.0, 0.05, 0.02))]
    alone = solve(skeleton, motion, target, limb=limb)
    together = solve(skeleton, motion, target, limb=limb, neighbours=Neighbours(np.arange(len(motion.rotations)), 9.0))
    assert np.array_equal(alone.motion.rotations, together.motion.rotations)


def test_an_elbow_does_not_snap_straight_or_folded() -> None:
    """The wrist is held while the body walks away from it and past it."""
    clip = generate_gait(1.3, 0.0, 3.0)
    shoulder, elbow, wrist = (_index(clip.skeleton, f"left_{part}") for part in ("shoulder", "elbow", "wrist"))
    held = {"kind": "position", "joint": "left_wrist", "frames": [60, 130]}

    def fastest(damping: float) -> float:
        edited = _constrained(clip, held, stretch_damping_deg=damping)
        places = kinematics.global_positions(edited)[60:130]
        upper, fore = places[:, shoulder] - places[:, elbow], places[:, wrist] - places[:, elbow]
        inner = np.arctan2(np.linalg.norm(np.cross(upper, fore), axis=-1), np.sum(upper * fore, axis=-1))
        return float(np.degrees(np.abs(np.diff(inner))).max())

    assert fastest(0.0) > 9.0
    assert fastest(40.0) < 0.6 * fastest(0.0)


@pytest.mark.parametrize("body", [studio_skeleton, game_skeleton])
def test_an_elbow_points_at_its_pole(body: Callable[[], Skeleton]) -> None:
    skeleton = body()
    clip = _resting(skeleton).as_clip(skeleton, 30.0)
    shoulder, elbow, wrist = (_index(skeleton, f"right_{part}") for part in ("shoulder", "elbow", "wrist"))
    places = kinematics.global_positions(clip)[0].astype(np.float64)
    target = places[shoulder] + 0.7 * (places[wrist] - places[shoulder])
    pole = places[shoulder] + (0.1, 0.4, -1.0)
    asked = {"kind": "position", "joint": "right_wrist", "point_m": target.tolist(), "pole_m": pole.tolist()}
    edited = kinematics.global_positions(_constrained(clip, asked)).astype(np.float64)
    line = (target - places[shoulder]) / np.linalg.norm(target - places[shoulder])
    for frame in (0, FRAMES // 2, FRAMES - 1):
        ways = np.stack((edited[frame, elbow] - edited[frame, shoulder], pole - edited[frame, shoulder]))
        ways -= (ways @ line)[:, None] * line
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        assert ways[0] @ ways[1] > 0.999
    assert np.linalg.norm(edited[:, wrist] - target, axis=1).max() < 1e-4
    with pytest.raises(EditError, match="a pole works only with the two-bone solver"):
        _constrained(clip, asked, solver="ccd")


@pytest.mark.parametrize("place", [{}, {"shift_m": [0.0, 0.0, 0.0]}], ids=["held", "as in the source"])
def test_an_elbow_turns_to_its_pole_where_the_wrist_is_already_in_place(place: dict[str, Any]) -> None:
    clip = generate_gait(1.2, 0.0, 3.0)
    shoulder, elbow, wrist = (_index(clip.skeleton, f"left_{part}") for part in ("shoulder", "elbow", "wrist"))
    before = kinematics.global_positions(clip).astype(np.float64)
    pole = before[90, elbow] + (0.6, 1.0, 0.0)
    edited = _constrained(
        clip, {"kind": "position", "joint": "left_wrist", "frames": [90, 110], "pole_m": pole.tolist(), **place}
    )
    after = kinematics.global_positions(edited).astype(np.float64)
    for frame in (90, 100, 109):
        line = after[frame, wrist] - after[frame, shoulder]
        line /= np.linalg.norm(line)
        ways = np.stack((after[frame, elbow] - after[frame, shoulder], pole - after[frame, shoulder]))
        ways -= (ways @ line)[:, None] * line
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        assert ways[0] @ ways[1] > 0.99
    steps = np.linalg.norm(np.diff(after[:, elbow], axis=0), axis=1)
    assert steps.max() < 0.08


@pytest.mark.parametrize("body", [studio_skeleton, game_skeleton])
def test_the_bend_of_a_hinge_is_positive_on_every_rig(body: Callable[[], Skeleton]) -> None:
    """Knees and elbows that may bend from 20 to 150 degrees are bent, and in their natural directions."""
    skeleton = body()
    clip = _resting(skeleton).as_clip(skeleton, 30.0)
    for side in ("left", "right"):
        limbs: tuple[tuple[str, str, str], ...] = (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))
        for names in limbs:
            first, middle, last = (_index(skeleton, f"{side}_{name}") for name in names)
            limit = {"kind": "hinge", "joint": f"{side}_{names[1]}", "angle_deg": [20.0, 150.0]}
            held = {"kind": "position", "joint": f"{side}_{names[2]}", "frames": [0, 1]}
            (edited,) = edit_clip(clip, EditDocument.model_validate({"commands": [
                {"command": "constrain", "constraints": [held], "limits": [limit], "blend_s": 0.0},
            ]}).commands)  # fmt: skip
            places = kinematics.global_positions(edited.clip)[0].astype(np.float64)
            spins = kinematics.global_rotations(edited.clip)[0].astype(np.float64)
            upper, lower = places[middle] - places[first], places[last] - places[middle]
            bend = np.cross(upper, lower)
            assert 19.0 < np.degrees(np.arctan2(np.linalg.norm(bend), upper @ lower)) < 151.0
            axes = guess_axes(skeleton, map_joints(skeleton))[skeleton.joint_names[middle]]
            natural = quaternions.rotate_vectors(spins[middle], np.array(axes.swing))
            assert (bend @ natural > 0.0) == (names[1] == "knee")  # elbows stretch about their swing axis

"""Conversion of motions to the canonical frame of reference, and back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.alignment_examples import body_of, moved, walk
from tests.support.edited_takes import under_static_root
from tests.support.tiers import examples

from marey_motion import quaternions
from marey_motion.alignment.canonical import placed, to_canonical
from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.kinematics import forward_directions
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion

BODY = body_of(walk())


def facing(motion: Motion, body: MatchingBody) -> Floats:
    return forward_directions(motion.positions(body.skeleton), body.lefts, body.rights)


@settings(max_examples=examples(30, soak=100))
@given(st.floats(-3.1, 3.1), st.floats(-9, 9), st.floats(-9, 9))
def test_wherever_a_clip_was_it_begins_where_the_axes_cross_and_faces_z(heading_rad: float, x: float, z: float) -> None:
    clip = moved(walk(), heading_rad, x, z)
    motion, placement = to_canonical(Motion.of(clip), BODY)
    assert motion.root_translations[0, ::2] == pytest.approx((0.0, 0.0), abs=1e-12)
    assert facing(motion, BODY)[0] == pytest.approx((0.0, 1.0), abs=1e-9)
    expected, _ = to_canonical(Motion.of(walk()), BODY)
    assert motion.positions(clip.skeleton) == pytest.approx(expected.positions(clip.skeleton), abs=1e-5)
    first = clip.root_translations[0]
    assert (placement.x, placement.z) == pytest.approx((first[0], first[2]))


def test_heights_are_kept_unless_they_are_not_wanted() -> None:
    motion = Motion.of(walk())
    kept, placement = to_canonical(motion, BODY)
    assert kept.root_translations[:, 1] == pytest.approx(motion.root_translations[:, 1])
    assert placement.y == 0.0
    low, placement = to_canonical(motion, BODY, keep_height=False)
    assert low.root_translations[0, 1] == pytest.approx(0.0, abs=1e-12)
    assert placement.y == pytest.approx(motion.root_translations[0, 1])


@pytest.mark.parametrize("keep_height", [True, False])
def test_placing_a_canonical_motion_brings_it_back(keep_height: bool) -> None:
    motion = Motion.of(moved(walk(), 2.3, 4.0, -1.5))
    canonical, placement = to_canonical(motion, BODY, keep_height=keep_height)
    back = placed(canonical, placement, BODY.skeleton)
    assert back.poses == pytest.approx(motion.poses, abs=1e-12)


def test_a_static_root_is_moved_along_while_the_body_is_turned_at_its_hips() -> None:
    clip = under_static_root(moved(walk(), 1.1, 2.0, 3.0), (0.3, 0.9, -4.0))
    body = body_of(clip)
    assert body.carrier == 1
    motion, placement = to_canonical(Motion.of(clip), body)
    assert motion.translated_joints == ()
    assert motion.rotations[:, 0] == pytest.approx(np.tile([1.0, 0.0, 0.0, 0.0], (60, 1)), abs=1e-12)
    expected, _ = to_canonical(Motion.of(walk()), BODY)
    found = motion.positions(clip.skeleton)[:, 1:]
    assert found == pytest.approx(expected.positions(walk().skeleton), abs=1e-5)
    back = placed(motion, placement, clip.skeleton).positions(clip.skeleton)[:, 1:]
    assert back == pytest.approx(Motion.of(clip).positions(clip.skeleton)[:, 1:], abs=1e-9)


def test_a_body_that_never_faces_anywhere_is_refused() -> None:
    motion = Motion.of(walk())
    lying = motion.rotations.copy()
    lying[:] = quaternions.identity(*lying.shape[:2])
    lying[:, 0] = quaternions.from_axis_angle((0.0, 0.0, 1.0), np.pi / 2)
    with pytest.raises(MotionError, match="above, below or at the right joints"):
        to_canonical(motion._replace(rotations=lying), BODY)

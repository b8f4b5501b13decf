"""The joint hierarchy: the values that it accepts, and the values that it derives."""

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from marey_motion import quaternions
from marey_motion.errors import SkeletonError, UnknownJoint
from marey_motion.skeleton import EndSite, Skeleton, same_hierarchy


def chain(**changes: Any) -> Skeleton:
    fields: dict[str, Any] = {
        "joint_names": ("a", "b", "c"),
        "parents": [-1, 0, 1],
        "offsets": [[0, 1, 0], [0, 0.5, 0], [0, 0.4, 0]],
        "rest_rotations": quaternions.identity(3),
    }
    return Skeleton(**(fields | changes))


def test_a_skeleton_takes_lists_and_holds_typed_read_only_arrays() -> None:
    skeleton = chain()

    assert skeleton.parents.dtype == np.int32
    assert skeleton.offsets.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        skeleton.offsets[0, 0] = 1.0


def test_the_callers_own_array_stays_writable() -> None:
    offsets = np.zeros((3, 3))
    chain(offsets=offsets)

    offsets[0, 0] = 1.0
    assert offsets[0, 0] == 1.0


@pytest.mark.parametrize(
    ("changes", "where", "words"),
    [
        ({"joint_names": ()}, "joint_names", "at least one"),
        ({"joint_names": ("a", "b", "a")}, "joint_names", "two joints are called 'a'"),
        ({"joint_names": ("a", "", "c")}, "joint_names", "joint 1"),
        ({"parents": [0, 0, 1]}, "a", "root"),
        ({"parents": [-1, 2, 1]}, "b", "earlier joint"),
        ({"parents": [-1, -1, 1]}, "b", "earlier joint"),
        ({"parents": [-1, 0]}, "parents", r"\(2,\)"),
        ({"offsets": np.zeros((3, 2))}, "offsets", r"\(3, 3\)"),
        ({"offsets": np.full((3, 3), np.nan)}, "offsets", "finite"),
        ({"offsets": np.zeros((3, 3), dtype=complex)}, "offsets", "complex"),
        ({"rest_rotations": np.full((3, 4), 0.9)}, "a", "unit quaternion"),
        ({"end_sites": (EndSite(3, np.zeros(3)),)}, "end_sites", "joint 3"),
        ({"display_names": ("a",)}, "display_names", "1 display names for 3 joints"),
    ],
)
def test_a_wrong_skeleton_is_refused_with_the_place_of_the_fault(
    changes: dict[str, Any], where: str, words: str
) -> None:
    with pytest.raises(SkeletonError, match=words) as caught:
        chain(**changes)
    assert caught.value.where == where
    assert caught.value.code == "skeleton-invalid"


def test_an_unknown_joint_is_answered_with_the_nearest_names(body: Skeleton) -> None:
    with pytest.raises(UnknownJoint, match="LeftLeg"):
        body.index_of("LeftLegg")
    assert body.index_of("LeftLeg") == 2
    assert "LeftLeg" in body
    assert "Tail" not in body


def test_children_and_the_path_to_the_root_follow_the_parents(body: Skeleton) -> None:
    assert [body.joint_names[joint] for joint in body.children[0]] == ["LeftUpLeg", "RightUpLeg", "Spine"]
    assert [body.joint_names[joint] for joint in body.path_to_root(3)] == ["LeftFoot", "LeftLeg", "LeftUpLeg", "Hips"]


def test_the_rest_pose_turns_with_the_rest_rotations() -> None:
    quarter = quaternions.from_axis_angle([0, 0, 1], np.pi / 2)
    skeleton = chain(rest_rotations=np.stack([quarter, quarter, quaternions.identity()]))

    np.testing.assert_allclose(
        skeleton.rest_global_positions, [[0.0, 1.0, 0.0], [-0.5, 1.0, 0.0], [-0.5, 0.6, 0.0]], atol=1e-15
    )


def test_the_rest_pose_is_to_the_bit_that_of_the_arithmetic_of_quaternions() -> None:
    rng = np.random.default_rng(5)
    parents = np.array([-1, *(int(rng.integers(joint)) for joint in range(1, 40))], np.int32)
    rest = np.asarray(quaternions.normalise(rng.normal(size=(40, 4))), np.float64)
    skeleton = Skeleton(tuple(map(str, range(40))), parents, rng.normal(size=(40, 3)), rest)

    turns, points = rest.copy(), skeleton.offsets.copy()
    for joint, parent in enumerate(parents[1:], start=1):
        turns[joint] = quaternions.multiply(turns[parent], turns[joint])
        points[joint] = points[parent] + quaternions.rotate_vectors(turns[parent], points[joint])

    assert skeleton.rest_global_rotations.tobytes() == turns.tobytes()
    assert skeleton.rest_global_positions.tobytes() == points.tobytes()


def test_the_same_content_is_the_same_hierarchy_whatever_the_display_names_or_the_quaternion_signs() -> None:
    skeleton = chain()

    assert same_hierarchy(skeleton, skeleton)
    assert same_hierarchy(skeleton, chain(display_names=("x", "x", "x")))
    assert same_hierarchy(skeleton, chain(rest_rotations=-quaternions.identity(3)))


def test_any_difference_of_structure_is_a_different_hierarchy() -> None:
    skeleton = chain()

    assert not same_hierarchy(skeleton, chain(joint_names=("a", "b", "d")))
    assert not same_hierarchy(skeleton, chain(parents=[-1, 0, 0]))
    assert not same_hierarchy(skeleton, chain(end_sites=(EndSite(2, np.zeros(3)),)))
    longer = chain(offsets=[[0, 1, 0], [0, 0.5, 0], [0, 0.401, 0]])
    assert not same_hierarchy(skeleton, longer)
    assert same_hierarchy(skeleton, longer, tolerance_m=0.002)
    bent = chain(rest_rotations=quaternions.from_axis_angle([1, 0, 0], [0.0, 0.1, 0.0]))
    assert not same_hierarchy(skeleton, bent)


def test_a_skeleton_survives_the_way_to_another_process(body: Skeleton) -> None:
    assert same_hierarchy(pickle.loads(pickle.dumps(body)), body)
    assert body.display_names == body.joint_names
    assert replace(body, display_names=("same",) * 22).display_names == ("same",) * 22

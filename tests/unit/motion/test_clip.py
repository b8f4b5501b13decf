"""Clips: the values that they accept, and the views that they return."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from marey_motion.arrays import AnyFloats
from marey_motion.clip import Clip
from marey_motion.errors import ClipError
from marey_motion.skeleton import Skeleton


@pytest.fixture
def still(body: Skeleton) -> AnyFloats:
    poses = np.zeros((10, 3 + 4 * body.joint_count), dtype=np.float32)
    poses[:, 3::4] = 1.0
    poses[:, 0] = np.arange(10)
    return poses


def test_a_clip_tells_its_length_and_gives_views_without_copying(body: Skeleton, still: AnyFloats) -> None:
    clip = Clip(body, 30.0, still)

    assert clip.frame_count == 10
    assert clip.duration_s == pytest.approx(1 / 3)
    assert clip.root_translations.shape == (10, 3)
    assert clip.rotations.shape == (10, 22, 4)
    assert np.shares_memory(clip.rotations, still)
    assert np.shares_memory(clip.root_translations, still)
    np.testing.assert_array_equal(clip.rotations[..., 0], 1.0)


def test_a_clip_cannot_be_changed_while_the_callers_array_can(body: Skeleton, still: AnyFloats) -> None:
    clip = Clip(body, 30.0, still)

    with pytest.raises(ValueError, match="read-only"):
        clip.rotations[0, 0, 0] = 0.0
    still[0, 0] = 5.0
    assert clip.root_translations[0, 0] == 5.0


def test_consecutive_slices_share_memory_and_add_up_to_the_clip(body: Skeleton, tumbling: Callable[..., Any]) -> None:
    clip = tumbling(body, frames=10, translated=(3, 5))
    first, second = clip.sliced(0, 4), clip.sliced(4, 10)

    np.testing.assert_array_equal(np.concatenate((first.poses, second.poses)), clip.poses)
    np.testing.assert_array_equal(np.concatenate((first.translations, second.translations)), clip.translations)
    assert np.shares_memory(second.poses, clip.poses)
    assert first.duration_s + second.duration_s == pytest.approx(clip.duration_s)


@pytest.mark.parametrize(("start", "stop"), [(-1, 4), (4, 4), (5, 3), (0, 11)])
def test_a_slice_outside_the_clip_is_refused(body: Skeleton, still: AnyFloats, start: int, stop: int) -> None:
    with pytest.raises(ClipError, match=f"{start}:{stop}"):
        Clip(body, 30.0, still).sliced(start, stop)


@pytest.mark.parametrize("rate", [0.0, -30.0, np.nan, np.inf])
def test_a_frame_rate_must_be_a_positive_number(body: Skeleton, still: AnyFloats, rate: float) -> None:
    with pytest.raises(ClipError) as caught:
        Clip(body, rate, still)
    assert caught.value.where == "frame_rate_hz"


def test_poses_of_the_wrong_width_name_the_width_needed(body: Skeleton, still: AnyFloats) -> None:
    with pytest.raises(ClipError, match="91"):
        Clip(body, 30.0, still[:, :-4])


@pytest.mark.parametrize("poses", [np.zeros((0, 91)), np.zeros(91), np.full((2, 91), "x")])
def test_poses_that_are_no_frames_of_numbers_are_refused(body: Skeleton, poses: NDArray[Any]) -> None:
    with pytest.raises(ClipError) as caught:
        Clip(body, 30.0, poses)
    assert caught.value.where == "poses"


def test_a_number_that_is_not_finite_is_found_by_frame(body: Skeleton, still: AnyFloats) -> None:
    still[7, 12] = np.nan
    with pytest.raises(ClipError, match="frame 7"):
        Clip(body, 30.0, still)


def test_a_rotation_that_is_not_unit_is_found_by_frame_and_joint(body: Skeleton, still: AnyFloats) -> None:
    still[6, 3 + 4 * 2] = 0.5
    with pytest.raises(ClipError, match=r"frame 6 .* 0\.5") as caught:
        Clip(body, 30.0, still)
    assert caught.value.where == "poses, joint LeftLeg"


@pytest.mark.parametrize(
    ("shape", "joints"),
    [
        (None, (1,)),
        ((10, 1, 3), ()),
        ((10, 0, 3), ()),
        ((10, 2, 3), (3, 1)),
        ((10, 1, 3), (0,)),
        ((10, 1, 3), (22,)),
        ((9, 1, 3), (1,)),
        ((10, 1, 2), (1,)),
    ],
)
def test_translations_must_fit_the_joints_they_move(
    body: Skeleton, still: AnyFloats, shape: tuple[int, int, int] | None, joints: tuple[Any, ...]
) -> None:
    translations = None if shape is None else np.zeros(shape, dtype=np.float32)
    with pytest.raises(ClipError, match=r".") as caught:
        Clip(body, 30.0, still, translations, joints)
    assert caught.value.where in ("translations", "translated_joints")


@pytest.mark.parametrize("square", [0.99801, 0.9985, 1.0, 1.0015, 1.00199])
def test_rotations_within_the_tolerance_are_accepted(body: Skeleton, still: AnyFloats, square: float) -> None:
    still[7, 3] = np.sqrt(square)
    assert Clip(body, 30.0, still).frame_count == 10


@pytest.mark.parametrize("square", [0.0, 0.99799, 1.00201, 1e60])
def test_one_rotation_beyond_the_tolerance_is_refused(body: Skeleton, still: AnyFloats, square: float) -> None:
    still[7, 3] = np.sqrt(square)
    with pytest.raises(ClipError, match="frame 7 must be a unit quaternion"):
        Clip(body, 30.0, still)

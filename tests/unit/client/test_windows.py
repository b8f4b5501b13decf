"""Windows of motions: clips whose windows do not fit together are refused before anything is read."""

from typing import Any

import pytest

from marey_client.poses.arrays import frames_text
from marey_client.poses.handle import PosesHandle
from marey_client.poses.windows import MotionWindows
from marey_client.transport import Transport
from marey_schemas.items import Item


def a_clip(path: str, *, rate_hz: float = 30.0, joints: int = 22) -> PosesHandle:
    """Return the handle of a clip with 100 frames, without a server."""
    item = {
        "id": path, "kind": "clip", "name": path, "collection": "", "revision": 1, "rev": 1,
        "created_at": "2026-01-01T00:00:00Z", "updated_at": "2026-01-01T00:00:00Z",
        "summary": {"joints": joints, "frames": 100, "frame_rate_hz": rate_hz},
    }  # fmt: skip
    return PosesHandle(Transport("http://marey.test", None), "lab", Item.model_validate(item))


def test_clips_of_different_rates_are_refused() -> None:
    clips = [a_clip("a"), a_clip("b"), a_clip("c", rate_hz=120.0)]
    with pytest.raises(
        ValueError, match="more than one frame rate: 30 in 'a', 120 in 'c'; choose clips of one frame rate"
    ):
        MotionWindows(clips, frames=30)


def test_clips_of_different_skeletons_need_the_names_of_joints() -> None:
    clips = [a_clip("a"), a_clip("b", joints=31)]
    with pytest.raises(ValueError, match="more than one number of joints: 22 in 'a', 31 in 'b'; name the joints"):
        MotionWindows(clips, frames=30)
    assert len(MotionWindows(clips, frames=30, joints=["Hips"])) == 6


@pytest.mark.parametrize("share", [0.0, -1.0, float("nan"), float("inf")])
def test_a_share_that_is_no_positive_number_is_refused(share: float) -> None:
    with pytest.raises(ValueError, match="needs a share above 0"):
        MotionWindows([a_clip("a")], frames=30).split({"train": share}, by="clip")


@pytest.mark.parametrize("frames", [5, (0, 5), [1, 2], "0:5"])
def test_frames_that_are_no_range_are_refused(frames: Any) -> None:
    with pytest.raises(ValueError, match=r"give a range such as slice\(0, 120\)"):
        a_clip("a").motion(frames=frames)


@pytest.mark.parametrize("frames", [slice("a", None), slice(0, 1.5), slice(-5, None)])
def test_bounds_of_a_range_are_whole_numbers_from_0(frames: slice) -> None:
    with pytest.raises(ValueError, match=r"frames: the bounds of slice.* must be whole numbers from 0"):
        frames_text(frames)

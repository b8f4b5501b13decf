"""Windows of motions: clips whose windows do not fit together are refused before anything is read."""

from types import SimpleNamespace
from typing import Any

import pytest

from marey_client.poses.arrays import frames_text
from marey_client.poses.windows import MotionWindows


def a_clip(path: str, *, rate_hz: float = 30.0, joints: int = 22) -> Any:
    """Return a substitute for the handle of a clip with 100 frames, with the attributes that `MotionWindows` uses."""
    item = SimpleNamespace(summary={"joints": joints})
    return SimpleNamespace(path=path, id=path, frames=100, frame_rate_hz=rate_hz, item=item)


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
        frames_text(frames)

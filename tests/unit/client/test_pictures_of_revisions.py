"""Frames of revisions with different frame rates: pictures and pages show them at the same times."""

from typing import Any

import numpy as np
import pytest

from marey_client.handles.clips import ClipHandle
from marey_client.poses import player_pages
from marey_client.poses.arrays import MotionArrays
from marey_client.poses.player_pages import motions_of_clips
from marey_client.poses.strips import ClipOfStrip
from marey_client.transport import Transport
from marey_schemas.items import Item

LENGTHS = {1: (50, 30.0), 2: (100, 60.0)}
"""Number of frames and frame rate of each revision."""


class TwiceImported(ClipHandle):
    """Clip that was imported again with twice the frame rate; without a server."""

    def motion(self, *, frames: slice | None = None, joints: Any = None, revision: int | None = None) -> MotionArrays:
        count, rate_hz = LENGTHS[revision or 2]
        poses = np.zeros((len(range(*(frames or slice(None)).indices(count))), 7), np.float32)
        skeleton: Any = {"item": "skeleton_1", "revision": 1}
        return MotionArrays(skeleton=skeleton, frame_rate_hz=rate_hz, joints=("Hips",), poses=poses)


@pytest.fixture
def clip() -> ClipHandle:
    item = {
        "id": "clip_1", "kind": "clip", "name": "walk", "collection": "", "revision": 2, "rev": 2,
        "created_at": "2026-01-01T00:00:00Z", "updated_at": "2026-01-01T00:00:00Z",
        "summary": {"joints": 1, "frames": 100, "frame_rate_hz": 60.0},
    }  # fmt: skip
    return TwiceImported(Transport("http://marey.test", None), "lab", Item.model_validate(item))


def test_a_picture_shows_the_frames_of_a_revision_at_the_times_of_the_other(clip: ClipHandle) -> None:
    earlier, newest = ClipOfStrip(clip, 1), ClipOfStrip(clip)
    assert [(one.frame_count, one.frame_rate_hz) for one in (earlier, newest)] == [LENGTHS[1], LENGTHS[2]]
    assert earlier.at_times_of(newest, [0, 60, 98]) == [0, 30, 49]
    assert newest.at_times_of(earlier, [0, 30]) == [0, 60]


def test_a_page_plays_the_frames_of_a_revision_at_the_times_of_the_other(
    clip: ClipHandle, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(player_pages, "shown_motion", lambda _item, name, motion: (name, len(motion.poses)))
    shown: Any = motions_of_clips([(clip, None), (clip, 1)], slice(60, 80))
    assert shown == [("walk, revision 2", 20), ("walk, revision 1", 10)]

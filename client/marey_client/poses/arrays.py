"""Handles of items with poses, which read only the requested frames and joints as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from marey_client.arguments import checks_arguments, several
from marey_client.errors import BadArgument
from marey_client.items import ItemHandle
from marey_schemas.documents.clips import MotionDocument


class MotionArrays(MotionDocument):
    """Poses of a clip, or of some of its frames and joints.

    Metres, right-handed with Y up; quaternions w, x, y, z. Members that a newer server adds are ignored.
    """

    model_config = ConfigDict(extra="ignore")

    @property
    def root_translations(self) -> NDArray[np.float32]:
        """(frames, 3) root positions, metres."""
        return self.poses[:, :3]

    @property
    def rotations(self) -> NDArray[np.float32]:
        """(frames, joints, 4) local rotations in the order of `joints`."""
        return self.poses[:, 3:].reshape(len(self.poses), -1, 4)


Joints = str | Sequence[str] | None
"""One joint or several, by name; None: all joints."""


@checks_arguments
class PosedItem(ItemHandle):
    """Handle of an item with the part `motion`.

    The argument `frames` is a slice such as `slice(0, 120)`; frames are counted from 0, and None means all frames. The
    argument `joints` contains names; the results have the joints in this order. Methods read the revision of the
    handle, except `motion`, which by default reads the newest revision.
    """

    @property
    def frames(self) -> int:
        """The number of frames."""
        return int(self.item.summary["frames"])

    @property
    def frame_rate_hz(self) -> float:
        """The number of frames per second."""
        return float(self.item.summary["frame_rate_hz"])

    @property
    def duration_s(self) -> float:
        """The duration in seconds."""
        return self.frames / self.frame_rate_hz

    def motion(
        self, *, frames: slice | None = None, joints: Joints = None, revision: int | None = None
    ) -> MotionArrays:
        """Return the poses as numpy arrays, by default those of the newest revision."""
        query = {"frames": frames_text(frames), "joints": ",".join(several(joints)) if joints is not None else None}
        return MotionArrays.model_validate(self.part("motion", revision=revision, **query))

    def joints(self) -> tuple[str, ...]:
        """Return the names of the joints, in the order of the arrays."""
        return self.motion(frames=slice(0, 1), revision=self.item.revision).joints

    def rotations(self, *, joints: Joints = None, frames: slice | None = None) -> NDArray[np.float32]:
        """Return the local rotations of joints: (frames, joints, 4), unit quaternions w, x, y, z."""
        return self.motion(frames=frames, joints=joints, revision=self.item.revision).rotations


def frames_text(frames: slice | None) -> str | None:
    """Return a slice of frames as the query parameter `first:end`; None, which means all frames, stays None.

    Raises `BadArgument` for a step other than 1, and for bounds that are negative or not whole numbers.
    """
    if frames is None:
        return None
    if frames.step not in (None, 1):
        raise BadArgument(
            f"frames: only ranges with a step of 1 can be requested, not {frames.step}; request "
            "the range, then take every n-th frame of the arrays"
        )
    bounds: tuple[Any, Any] = (frames.start, frames.stop)
    if not all(bound is None or (isinstance(bound, (int, Integral)) and int(bound) >= 0) for bound in bounds):
        raise BadArgument(f"frames: the bounds of {frames} must be whole numbers from 0; frames are counted from 0")
    return ":".join("" if bound is None else str(bound) for bound in bounds)

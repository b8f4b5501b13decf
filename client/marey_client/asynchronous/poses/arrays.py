"""Counterparts of `marey_client.poses.arrays` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.items import AsyncItemHandle
from marey_client.poses.arrays import Joints, MotionArrays, PosedItem


@counterpart_of(PosedItem)
class AsyncPosedItem(AsyncItemHandle):
    """Handle of an item with the part `motion`.

    The argument `frames` is a slice such as `slice(0, 120)`; frames are counted from 0, and None means all frames. The
    argument `joints` contains names; the results have the joints in this order. Methods read the revision of the
    handle, except `motion`, which by default reads the newest revision.
    """

    _sync: PosedItem

    @property
    def frames(self) -> int:
        """The number of frames."""
        return self._sync.frames

    @property
    def frame_rate_hz(self) -> float:
        """The number of frames per second."""
        return self._sync.frame_rate_hz

    @property
    def duration_s(self) -> float:
        """The duration in seconds."""
        return self._sync.duration_s

    async def motion(
        self, *, frames: slice | None = None, joints: Joints = None, revision: int | None = None
    ) -> MotionArrays:
        """Return the poses as numpy arrays, by default those of the newest revision."""
        return await self._run(self._sync.motion, frames=frames, joints=joints, revision=revision)

    async def joints(self) -> tuple[str, ...]:
        """Return the names of the joints, in the order of the arrays."""
        return await self._run(self._sync.joints)

    async def rotations(self, *, joints: Joints = None, frames: slice | None = None) -> NDArray[np.float32]:
        """Return the local rotations of joints: (frames, joints, 4), unit quaternions w, x, y, z."""
        return await self._run(self._sync.rotations, joints=joints, frames=frames)

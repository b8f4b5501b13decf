"""Counterparts of `marey_client.poses.handle` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.poses.arrays import AsyncPosedItem
from marey_client.poses.arrays import Joints
from marey_client.poses.handle import PosesHandle
from marey_client.poses.pictures import MotionPicture


@counterpart_of(PosesHandle)
class AsyncPosesHandle(AsyncPosedItem):
    """Handle of an item with poses. Arguments and arrays are those of `PosedItem`."""

    _sync: PosesHandle

    async def positions(self, *, joints: Joints = None, frames: slice | None = None) -> NDArray[np.float32]:
        """Return the positions of joints in the world: (frames, joints, 3), metres, Y up.

        Only the given joints and the joints between them and the root are read. Raises `NoSuchJoint`, which names the
        most similar joint, if the skeleton lacks a joint, and `MissingPackage` without the extra `motion`.
        """
        return await self._run(self._sync.positions, joints=joints, frames=frames)

    async def velocities(self, *, joints: Joints = None, frames: slice | None = None) -> NDArray[np.float32]:
        """Return the velocities of joints in the world: (frames, joints, 3), metres per second, Y up.

        Velocities are central differences. At the ends of the range, they use the frames outside of the range, too.
        Raises the errors of `positions`.
        """
        return await self._run(self._sync.velocities, joints=joints, frames=frames)

    async def contacts(self, *, frames: slice | None = None) -> NDArray[np.bool_]:
        """Return whether the left and the right foot touch the ground: (frames, 2), True if so.

        A foot touches the ground while its toe is slow (`marey_motion.foot_contacts`). The command `find_contacts` of
        edits detects contacts in whole clips, and also allows for the rolling of the foot. Raises `NoSuchJoint` if the
        mapping of the skeleton has no feet, and `MissingPackage` without the extra `motion`.
        """
        return await self._run(self._sync.contacts, frames=frames)

    async def to_dataframe(self, *, joints: Joints = None, frames: slice | None = None) -> Any:
        """Return the positions of joints as a pandas table, in metres.

        There is one row for each frame, with the time in seconds as index, and columns such as `("Hips", "y")`. Raises
        the errors of `positions`, and `MissingPackage` without the extra `notebook`.
        """
        exchanged: Any = await self._exchange(self._sync.to_dataframe, joints=joints, frames=frames)
        return exchanged

    async def to_arrow(self, *, joints: Joints = None, frames: slice | None = None) -> Any:
        """Return the positions of joints as a table of pyarrow, in metres.

        The columns are `frame`, `time_s`, and lists of three numbers with the names of the joints. Raises the errors
        of `to_dataframe`.
        """
        exchanged: Any = await self._exchange(self._sync.to_arrow, joints=joints, frames=frames)
        return exchanged

    async def to_xarray(self, *, joints: Joints = None, frames: slice | None = None) -> Any:
        """Return positions and local rotations as a dataset of xarray.

        Its dimensions are `time_s`, `joint`, `axis` (x, y, z) and `component` (w, x, y, z). Raises the errors of
        `to_dataframe`.
        """
        exchanged: Any = await self._exchange(self._sync.to_xarray, joints=joints, frames=frames)
        return exchanged

    async def plot(self, *, frames: slice | None = None, moments: int = 8) -> MotionPicture:
        """Draw the poses at `moments` frames, evenly spaced over the range; notebooks show the picture.

        Only the drawn frames are read. Raises `MissingPackage` without the extra `figures`.
        """
        return await self._run(self._sync.plot, frames=frames, moments=moments)

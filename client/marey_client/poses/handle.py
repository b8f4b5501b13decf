"""Handles of items with poses: positions, velocities, contacts, tables and pictures of a clip."""

from __future__ import annotations

import html
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_client.arguments import checks_arguments
from marey_client.errors import MareyError
from marey_client.poses.arrays import Joints, PosedItem
from marey_client.poses.frame_tables import to_arrow, to_dataframe, to_xarray
from marey_client.poses.kinematics import read_contacts, read_positions, read_velocities
from marey_client.poses.pictures import MotionPicture, draw_poses


@checks_arguments
class PosesHandle(PosedItem):
    """Handle of an item with poses. Arguments and arrays are those of `PosedItem`."""

    def positions(self, *, joints: Joints = None, frames: slice | None = None) -> NDArray[np.float32]:
        """Return the positions of joints in the world: (frames, joints, 3), metres, Y up.

        Only the given joints and the joints between them and the root are read. Raises `NoSuchJoint`, which names the
        most similar joint, if the skeleton lacks a joint, and `MissingPackage` without the extra `motion`.
        """
        return read_positions(self, joints, frames)

    def velocities(self, *, joints: Joints = None, frames: slice | None = None) -> NDArray[np.float32]:
        """Return the velocities of joints in the world: (frames, joints, 3), metres per second, Y up.

        Velocities are central differences. At the ends of the range, they use the frames outside of the range, too.
        Raises the errors of `positions`.
        """
        return read_velocities(self, joints, frames)

    def contacts(self, *, frames: slice | None = None) -> NDArray[np.bool_]:
        """Return whether the left and the right foot touch the ground: (frames, 2), True if so.

        A foot touches the ground while its toe is slow (`marey_motion.foot_contacts`). The command `find_contacts` of
        edits detects contacts in whole clips, and also allows for the rolling of the foot. Raises `NoSuchJoint` if the
        mapping of the skeleton has no feet, and `MissingPackage` without the extra `motion`.
        """
        return read_contacts(self, frames)

    def to_dataframe(self, *, joints: Joints = None, frames: slice | None = None) -> Any:
        """Return the positions of joints as a pandas table, in metres.

        There is one row for each frame, with the time in seconds as index, and columns such as `("Hips", "y")`. Raises
        the errors of `positions`, and `MissingPackage` without the extra `notebook`.
        """
        return to_dataframe(self, joints, frames)

    def to_arrow(self, *, joints: Joints = None, frames: slice | None = None) -> Any:
        """Return the positions of joints as a table of pyarrow, in metres.

        The columns are `frame`, `time_s`, and lists of three numbers with the names of the joints. Raises the errors
        of `to_dataframe`.
        """
        return to_arrow(self, joints, frames)

    def to_xarray(self, *, joints: Joints = None, frames: slice | None = None) -> Any:
        """Return positions and local rotations as a dataset of xarray.

        Its dimensions are `time_s`, `joint`, `axis` (x, y, z) and `component` (w, x, y, z). Raises the errors of
        `to_dataframe`.
        """
        return to_xarray(self, joints, frames)

    def plot(self, *, frames: slice | None = None, moments: int = 8) -> MotionPicture:
        """Draw the poses at `moments` frames, evenly spaced over the range; notebooks show the picture.

        Only the drawn frames are read. Raises `MissingPackage` without the extra `figures`.
        """
        return draw_poses(self, frames, moments)

    def _repr_html_(self) -> str:
        """Return path, revision, length and a strip of poses as HTML, which notebooks show."""
        facts = f"{self.frames:,} frames at {self.frame_rate_hz:g} Hz, {self.duration_s:.2f} s"
        text = f"<p><b>{html.escape(self.path)}</b>, revision {self.item.revision}: {facts}</p>"
        try:
            return text + self.plot().svg
        except MareyError as error:
            return f"{text}<p>No picture: {html.escape(str(error))}</p>"

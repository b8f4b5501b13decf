"""Handles of items with poses, which read only the requested frames and joints as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from marey_client.arguments import checks_arguments, several
from marey_client.errors import BadArgument, NoSuchJoint
from marey_client.items import ItemHandle
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.sizes import MOST_QUERY_VALUES


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


LONGEST_NAMES = 4000
"""Greatest number of characters of names of joints in the address of a request; proxies refuse long addresses."""

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
        names = None if joints is None else several(joints)
        asked = None if names is None or not _fit_query(names) else ",".join(names)
        query = {"frames": frames_text(frames), "joints": asked}
        found = MotionArrays.model_validate(self.part("motion", revision=revision, **query))
        return found if names is None or asked is not None else _only_joints(found, names)

    def joints(self) -> tuple[str, ...]:
        """Return the names of the joints, in the order of the arrays."""
        return self.motion(frames=slice(0, 1), revision=self.item.revision).joints

    def rotations(self, *, joints: Joints = None, frames: slice | None = None) -> NDArray[np.float32]:
        """Return the local rotations of joints: (frames, joints, 4), unit quaternions w, x, y, z."""
        return self.motion(frames=frames, joints=joints, revision=self.item.revision).rotations


def _fit_query(names: Sequence[str]) -> bool:
    """Return whether a request can name these joints; their number, a comma or the length of the address may forbid it.

    If it cannot, all joints are requested.
    """
    return len(names) <= MOST_QUERY_VALUES and len("".join(names)) <= LONGEST_NAMES and "," not in "".join(names)


def _only_joints(motion: MotionArrays, names: Sequence[str]) -> MotionArrays:
    """Return some joints of a motion, in the order of `names`; the translation of the root is always kept."""
    places = {name: place for place, name in enumerate(motion.joints)}
    if unknown := [name for name in names if name not in places]:
        raise NoSuchJoint(f"the motion has no joint {unknown[0]!r}; `joints()` returns the names of all joints")
    if len(set(names)) != len(names):
        raise BadArgument("joints: give no joint twice")
    turns = motion.rotations[:, [places[name] for name in names]].reshape(len(motion.poses), -1)
    kept = [place for place, name in enumerate(motion.translated_joints) if name in set(names)]
    moved = motion.translations
    return motion.model_copy(
        update={
            "joints": tuple(names),
            "poses": np.concatenate((motion.root_translations, turns), axis=1),
            "translated_joints": tuple(motion.translated_joints[place] for place in kept),
            "translations": moved[:, kept] if moved is not None and kept else None,
        }
    )


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

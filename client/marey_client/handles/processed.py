"""Aligned clips: ask for them, and read what alignment made of each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from marey_client.handles.clips import ClipHandle, MotionArrays, frames_text
from marey_client.items import ItemHandle
from marey_client.one_or_several import several
from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.items import Item
from marey_schemas.kinds import Kind


class ProcessedHandle(ItemHandle):
    """One aligned clip: canonical frames of an action, and the way back to the clip that they come from."""

    def motion(
        self, *, frames: slice | None = None, joints: str | Sequence[str] | None = None, revision: int | None = None
    ) -> MotionArrays:
        """Its canonical frames, in the canonical frame of reference."""
        query = {"frames": frames_text(frames), "joints": ",".join(several(joints)) if joints is not None else None}
        return MotionArrays.model_validate(self.part("motion", revision=revision, **query))

    def info(self, *, revision: int | None = None) -> AlignmentInfo:
        """Which set it belongs to, its keyframes, cost and options, and where and when its frames were."""
        return AlignmentInfo.model_validate(self.part("info", revision=revision))

    def time_function(self) -> NDArray[np.float64]:
        """(N,) fractional frame of the source, counted at the set's rate, at each canonical frame."""
        return self.info().time_function

    def source(self) -> ClipHandle | None:
        """The clip it comes from, as it is now; None where that is not in the store."""
        clip = self.info().clip
        if clip is None:
            return None
        item = self.transport.get(Item, f"/projects/{self.project}/{Kind.CLIP.plural}/{clip.item}")
        return ClipHandle(self.transport, self.project, item)

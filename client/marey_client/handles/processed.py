"""Handles of aligned clips: canonical frames, time functions (the source frame of each canonical frame), sources."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marey_client.arguments import checks_arguments
from marey_client.handles.clips import ClipHandle
from marey_client.poses.handle import PosesHandle
from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.items import Item
from marey_schemas.kinds import Kind


@checks_arguments
class ProcessedHandle(PosesHandle):
    """Handle of an aligned clip: poses at the canonical frames of an action, and the source frame of each of them.

    Positions are in the canonical frame of reference.
    """

    def info(self, *, revision: int | None = None) -> AlignmentInfo:
        """Return the part `info`: keyframes, cost and options of the alignment, and the time function."""
        return AlignmentInfo.model_validate(self.part("info", revision=revision))

    def time_function(self) -> NDArray[np.float64]:
        """Return the source frame of each canonical frame, as an array (N,) of fractional frame numbers.

        Source frames are counted at the rate of the aligned clip.
        """
        return self.info().time_function

    def source(self) -> ClipHandle | None:
        """Return the source clip at its newest revision; None if the source is not a stored clip."""
        clip = self.info().clip
        if clip is None:
            return None
        item = self.transport.get(Item, f"/projects/{self.project}/{Kind.CLIP.plural}/{clip.item}")
        return ClipHandle(self.transport, self.project, item)

"""Bodies whose quality is measured, one for each skeleton of the clips of a job."""

from __future__ import annotations

from collections.abc import Iterable

from marey_motion import documents
from marey_motion.clip import Clip
from marey_motion.quality.measuring import QualityBody
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import Context
from marey_worker.job_io.matching_clips import skeleton_of
from marey_worker.job_io.skeleton_cache import Rig, read_mapped


class QualityBodies:
    """Bodies of skeletons, each made once.

    `rigs` are revisions of skeletons whose joint mappings are used instead of those that the clips refer to.
    """

    def __init__(self, context: Context, rigs: Iterable[PinnedInput] = ()) -> None:
        self._context = context
        self._rigs = {pin.item: pin for pin in rigs}
        self._bodies: dict[Rig, QualityBody] = {}

    def posed(self, motion: MotionDocument) -> tuple[Clip, QualityBody]:
        """Return a motion as a clip, and the body of its skeleton.

        Raises `MotionError` if the skeleton has no mapping that shows feet, hips and shoulders.
        """
        used = skeleton_of(motion)
        edited = self._rigs.get(used.item)
        rig = Rig(used, edited.ref if edited else used)
        mapped = read_mapped(self._context, rig)
        if rig not in self._bodies:
            self._bodies[rig] = QualityBody.of(mapped.skeleton, mapped.mapping, mapped.axes)
        return documents.clip_from_document(motion, mapped.skeleton), self._bodies[rig]

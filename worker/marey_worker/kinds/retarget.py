"""Kind `retarget`: transfers clips of any skeleton to one skeleton."""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

from marey_motion import documents
from marey_motion.errors import MotionError
from marey_motion.importing.checks import CheckWarning
from marey_motion.retargeting import RetargetPlan, retarget_with_checks
from marey_schemas.documents.clips import Check, ClipInfo, ClipSource, MotionDocument
from marey_schemas.documents.references import RevisionRef
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_params import RetargetParams
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.refusals import UNUSABLE, Refusals, present
from marey_worker.job_io.result_places import ResultPlaces
from marey_worker.job_io.skeleton_cache import MappedSkeleton, Rig, plan_between, read_mapped
from marey_worker.job_io.staged_results import StagedResults

_FROM_CLIP = (
    "neither the rest pose nor the names of the source skeleton show the axes of these joints, so they were read from "
    "this clip; other clips may be turned differently; state the axes with `marey skeleton axes`"
)
_GUESSED = (
    "neither the rest pose nor the names of the target skeleton show the axes of these joints, so they were guessed; "
    "the joints of the result may be turned about their bones; state the axes with `marey skeleton axes`"
)


def run(context: Context, params: RetargetParams) -> dict[str, Any]:
    """Retarget every clip of the job.

    A clip that cannot be retargeted is listed as a refusal in the result, with code and reason. The result counts the
    clips with a warning, by code; the part `info` of each such clip contains the warning. Raises `JobRefused` if no
    clip can be retargeted.
    """
    return _Retargeting(context, params).run()


class _Retargeting:
    """State of a job of the kind `retarget`."""

    def __init__(self, context: Context, params: RetargetParams) -> None:
        self._context = context
        self._params = params
        self._refusals = Refusals(context)
        self._results = StagedResults(context)
        self._places = ResultPlaces(context)
        self._frames = 0
        self._warnings: Counter[str] = Counter()

        (self._target_pin,) = context.inputs["skeleton"]
        self._target = Rig.as_stored(self._target_pin.ref)
        self._rigs = {pin.item: pin for pin in context.inputs.get("rigs", ())}
        try:
            read_mapped(context, self._target)
        except MotionError as error:
            raise JobRefused(
                error.code, f"the target skeleton {self._target_pin.name} cannot be used: {error}"
            ) from error

    def run(self) -> dict[str, Any]:
        """Retarget all clips, and return the result of the job."""
        pins = self._context.inputs["clips"]
        started = time.monotonic()
        for done, (pin, (motion, info)) in enumerate(self._context.documents_of_each(pins, "motion", "info")):
            self._context.progress(done, len(pins), f"retargeting {pin.name}")
            try:
                self._results.add(self._retargeted(pin, MotionDocument.model_validate(present(pin, motion)), info))
            except UNUSABLE as error:
                self._refusals.add(pin, error)
        self._refusals.require_some(self._results.count, len(pins), "retargeted")
        self._results.flush()
        return {
            "clips": self._results.count,
            "frames": self._frames,
            "seconds": round(time.monotonic() - started, 4),
            "warnings": dict(self._warnings),
            "refused": self._refusals.entries,
        }

    def _retargeted(self, pin: PinnedInput, motion: MotionDocument, info: dict[str, Any] | None) -> StagedOutput:
        name = f"{pin.name}{self._params.suffix}"
        self._places.take(Kind.CLIP, pin.folder, name)
        used = RevisionRef.model_validate(motion.skeleton.model_dump())
        edited = self._rigs.get(used.item)
        source = Rig(used, edited.ref if edited else used)
        mapped = read_mapped(self._context, source)
        moving = documents.clip_from_document(motion, mapped.skeleton)
        plan = plan_between(self._context, source, self._target, self._params.scale, moving)
        made = retarget_with_checks(moving, plan, self._params)
        found = (*self._unknown_axes(mapped, plan), *made.checks)
        checks = tuple(Check.model_validate(check.as_dict()) for check in found)
        clip = made.clip
        self._warnings.update(check.code for check in checks)
        self._frames += clip.frame_count
        return StagedOutput(
            name=f"{pin.collection}/{pin.name}",
            kind=Kind.CLIP,
            item_name=name,
            collection=pin.folder,
            tags=self._params.tags,
            parts={
                "motion": documents.clip_to_document(clip, self._target.skeleton).model_dump(by_alias=True),
                "info": self._info(info, plan, checks).model_dump(mode="json", by_alias=True, exclude_none=True),
            },
            sources={
                "clips": (pin.as_input(),),
                "skeleton": (self._target_pin.as_input(),),
                **({"rigs": (edited.as_input(),)} if edited else {}),
            },
        )

    def _unknown_axes(self, source: MappedSkeleton, plan: RetargetPlan) -> list[CheckWarning]:
        """Return warnings about paired joints whose axes the skeleton does not show and no user has stated."""
        target = read_mapped(self._context, self._target)
        both = (
            (source.guessed, [pair.source for pair in plan.pairs], "axes-from-clip", _FROM_CLIP),
            (target.guessed, [pair.target for pair in plan.pairs], "axes-guessed", _GUESSED),
        )
        return [
            CheckWarning(code, text, joints=joints)
            for guessed, names, code, text in both
            if (joints := tuple(name for name in names if name in guessed))
        ]

    def _info(self, stored: dict[str, Any] | None, plan: RetargetPlan, checks: tuple[Check, ...]) -> ClipInfo:
        """Return the part `info` of a result: that of the source clip, with a new origin and new checks."""
        details = {
            "scale": plan.scale,
            "mapped": len(plan.pairs),
            "missing": list(plan.missing),
            "at_rest": list(plan.at_rest),
            "carried": list(plan.carried),
        }
        made = ClipSource(format="retargeted", details=details)
        if stored is None:
            return ClipInfo(source=made, checks=checks)
        return ClipInfo.model_validate(stored).model_copy(update={"source": made, "checks": checks})

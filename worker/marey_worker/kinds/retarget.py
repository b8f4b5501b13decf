"""Clips of any skeleton onto one skeleton."""

from __future__ import annotations

import time
from typing import Any

from pydantic import ValidationError

from marey_motion import documents
from marey_motion.errors import MotionError
from marey_motion.retargeting import RetargetPlan, retarget
from marey_schemas.documents import ClipInfo, Motion, RevisionRef, Source
from marey_schemas.jobs import ItemInput, PinnedInput, RetargetParams, StagedOutput
from marey_schemas.kinds import Kind
from marey_worker.context import Context, JobRefused, NoSuchThing
from marey_worker.kinds.rigged import Rig, plan_between, read_rigged

BYTES_PER_STAGE = 2 << 20  # small enough for the server to take results in while the next are computed
OUTPUTS_PER_STAGE = 64


def run(context: Context, params: RetargetParams) -> dict[str, Any]:
    """Retarget every clip of the job.

    A clip that cannot be retargeted is a refusal in the result, with code and reason; the others are made all the same.
    """
    return _Retargeting(context, params).run()


class _Retargeting:
    """One job."""

    def __init__(self, context: Context, params: RetargetParams) -> None:
        self._context = context
        self._params = params
        self._refused: list[dict[str, Any]] = []
        self._ready: list[StagedOutput] = []
        self._ready_bytes = 0
        self._frames = 0
        self._made = 0

        (self._target_pin,) = context.inputs["skeleton"]
        self._target = Rig.as_stored(_ref(self._target_pin))
        self._rigs = {pin.item: pin for pin in context.inputs.get("rigs", ())}
        try:
            read_rigged(context, self._target)
        except MotionError as error:
            raise JobRefused(error.code, f"skeleton {self._target_pin.name}: {error}") from error

    def run(self) -> dict[str, Any]:
        """All clips; what became of them."""
        pins = self._context.inputs["clips"]
        started = time.monotonic()
        for done, (pin, motion) in enumerate(self._context.documents(pins, "motion")):
            self._context.progress(done, len(pins), f"retargeting {pin.name}")
            try:
                self._add(self._retargeted(pin, Motion.model_validate(motion)))
            except (MotionError, ValidationError) as error:
                self._refuse(pin, error)
        self._flush()
        return {
            "clips": self._made,
            "frames": self._frames,
            "seconds": round(time.monotonic() - started, 4),
            "refused": self._refused,
        }

    def _retargeted(self, pin: PinnedInput, motion: Motion) -> StagedOutput:
        used = RevisionRef.model_validate(motion.skeleton.model_dump())
        edited = self._rigs.get(used.item)
        source = Rig(used, _ref(edited) if edited else used)
        plan = plan_between(self._context, source, self._target, self._params.scale)
        clip = retarget(documents.clip_from_document(motion, plan.source), plan)
        self._frames += clip.frame_count
        return StagedOutput(
            name=f"{pin.collection}/{pin.name}",
            kind=Kind.CLIP,
            item_name=f"{pin.name}{self._params.suffix}",
            collection=pin.folder,
            tags=self._params.tags,
            parts={
                "motion": documents.clip_to_document(clip, self._target.skeleton).model_dump(by_alias=True),
                "info": self._info(pin, plan).model_dump(mode="json", by_alias=True, exclude_none=True),
            },
            sources={
                "clips": (_input(pin),),
                "skeleton": (_input(self._target_pin),),
                **({"rigs": (_input(edited),)} if edited else {}),
            },
        )

    def _info(self, pin: PinnedInput, plan: RetargetPlan) -> ClipInfo:
        """What was known of the source and holds for the result, and how it was made."""
        details = {
            "scale": plan.scale,
            "mapped": len(plan.pairs),
            "missing": list(plan.missing),
            "at_rest": list(plan.at_rest),
            "carried": list(plan.carried),
        }
        made = Source(format="retargeted", details=details)
        try:
            stored = self._context.document(Kind.CLIP, pin.item, pin.revision, "info")
        except NoSuchThing:
            return ClipInfo(source=made)
        known = ClipInfo.model_validate(stored)
        return known.model_copy(update={"source": made, "checks": ()})

    # -- results --

    def _refuse(self, pin: PinnedInput, error: MotionError | ValidationError) -> None:
        code = error.code if isinstance(error, MotionError) else "bad-document"
        place = f"{pin.collection}/{pin.name}".lstrip("/")
        self._context.log(f"{place}: {error}")
        self._refused.append({"name": place, "item": pin.item, "code": code, "detail": str(error)})

    def _add(self, output: StagedOutput) -> None:
        self._made += 1
        self._ready.append(output)
        self._ready_bytes += output.parts["motion"]["poses"].nbytes
        if self._ready_bytes > BYTES_PER_STAGE or len(self._ready) >= OUTPUTS_PER_STAGE:
            self._flush()

    def _flush(self) -> None:
        if self._ready:
            self._context.stage(self._ready)
        self._ready, self._ready_bytes = [], 0


def _ref(pin: PinnedInput) -> RevisionRef:
    return RevisionRef(item=pin.item, revision=pin.revision)


def _input(pin: PinnedInput) -> ItemInput:
    return ItemInput(item=pin.item, revision=pin.revision)

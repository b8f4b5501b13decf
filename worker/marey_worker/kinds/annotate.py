"""Kind `annotate`: annotates clips with segments and keyframes that an algorithm proposes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from marey_motion import documents
from marey_motion.clip import Clip
from marey_motion.editing.annotations.layers import Layer
from marey_motion.editing.annotations.speed_proposals import propose_pauses, propose_reaches
from marey_motion.editing.annotations.step_proposals import propose_steps
from marey_motion.errors import AnnotationError, UnknownJoint
from marey_motion.matching.body import MatchingBody
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.references import RevisionRef
from marey_schemas.kinds import Kind
from marey_schemas.names import MAX_NAME_LENGTH
from marey_schemas.options.annotations import StepsProposal, WristContactProposal
from marey_schemas.queue.job_params import AnnotateParams
from marey_schemas.queue.jobs import ItemInput
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput
from marey_worker.context import Context
from marey_worker.job_io.refusals import UNUSABLE, Refusals, present
from marey_worker.job_io.result_places import require_different
from marey_worker.job_io.skeleton_cache import MappedSkeleton, Rig, read_mapped
from marey_worker.job_io.staged_results import StagedResults

Propose = Callable[[Clip, MappedSkeleton], Layer]


def run(context: Context, params: AnnotateParams) -> dict[str, Any]:
    """Annotate every clip of the job.

    A clip that cannot be annotated is listed as a refusal in the result, with code and reason. A clip in which nothing
    is found gets no annotation. Raises `JobRefused` if two annotations would have the same name, or if no clip can be
    annotated.
    """
    propose = _proposal(params)
    rigs = {pin.item: pin for pin in context.inputs.get("rigs", ())}
    pins = context.inputs["clips"]
    require_different((pin.folder, pin.name) for pin in pins)
    layer_name = params.layer or params.proposal.method
    labels: Counter[str] = Counter()
    refusals = Refusals(context)
    empty: list[str] = []
    results = StagedResults(context)
    for done, (pin, tree) in enumerate(context.documents(pins, "motion", required=False)):
        context.progress(done, len(pins), f"annotating {pin.name}")
        try:
            motion = MotionDocument.model_validate(present(pin, tree))
            used = RevisionRef.model_validate(motion.skeleton.model_dump())
            edited = rigs.get(used.item)
            mapped = read_mapped(context, Rig(used, edited.ref if edited else used))
            layer = propose(documents.clip_from_document(motion, mapped.skeleton), mapped)
            _require_name(pin, layer_name)
        except UNUSABLE as error:
            refusals.add(pin, error)
            continue
        if not (layer.segments or layer.keyframes):
            empty.append(pin.path)
            continue
        labels.update(segment.label for segment in layer.segments)
        sources: dict[str, tuple[ItemInput, ...]] = {
            "clips": (pin.as_input(),),
            **({"rigs": (edited.as_input(),)} if edited else {}),
        }
        results.add(_output(pin, layer, layer_name, params, sources))
    refusals.require_some(results.count + len(empty), len(pins), "annotated")
    results.flush()
    return {
        "annotations": results.count,
        "segments": dict(sorted(labels.items())),
        "empty": empty,
        "refused": refusals.entries,
    }


def _proposal(params: AnnotateParams) -> Propose:
    """Return the function that proposes segments and keyframes for a clip, as the parameters of the job request it."""
    wanted = params.proposal
    if isinstance(wanted, StepsProposal):
        return lambda clip, mapped: propose_steps(clip, _body(mapped), wanted)
    if isinstance(wanted, WristContactProposal):
        return lambda clip, mapped: propose_reaches(clip, _body(mapped), wanted)
    return lambda clip, mapped: propose_pauses(clip, _joints(mapped, wanted.joints), wanted)


def _joints(mapped: MappedSkeleton, names: Sequence[str]) -> tuple[int, ...]:
    """Return the indices of joints that are given by their own names or their standard names.

    Raises `UnknownJoint` if neither the skeleton nor its joint mapping has such a joint.
    """
    found = []
    for name in names:
        own = name if name in mapped.skeleton else mapped.mapping.joints.get(name)
        if own is None:
            raise UnknownJoint(
                f"neither the skeleton nor its joint mapping has a joint {name!r}; give the name of a joint", where=name
            )
        found.append(mapped.skeleton.index_of(own))
    return tuple(found)


def _body(mapped: MappedSkeleton) -> MatchingBody:
    return MatchingBody.from_mapping(mapped.skeleton, mapped.mapping)


def _require_name(pin: PinnedInput, layer_name: str) -> None:
    if len(pin.name) + 1 + len(layer_name) > MAX_NAME_LENGTH:
        raise AnnotationError(
            f"the names of the clip and the layer together have more than {MAX_NAME_LENGTH} characters; give a shorter "
            "name of the layer, or rename the clip",
            code="name-too-long",
        )


def _output(
    pin: PinnedInput, layer: Layer, name: str, params: AnnotateParams, sources: dict[str, tuple[ItemInput, ...]]
) -> StagedOutput:
    document = documents.layer_to_document(layer, pin.ref, name, "algorithm")
    return StagedOutput(
        name=f"{pin.collection}/{pin.name}",
        kind=Kind.ANNOTATION,
        item_name=f"{pin.name} {name}",
        collection=pin.folder,
        tags=params.tags,
        parts={"annotation": document.model_dump(mode="json", by_alias=True)},
        sources=sources,
    )

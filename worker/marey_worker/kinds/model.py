"""Kind `model`: trains a generative model of one action on aligned clips, and writes its report."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from marey_motion import documents
from marey_motion.alignment.aligned import AlignedSet
from marey_motion.alignment.aligned_documents import StoredExample, set_from_examples, uid_of
from marey_motion.errors import MappingError
from marey_motion.modelling.primitive_documents import trained_to_tree
from marey_motion.modelling.search.check import SearchCheck, check_search
from marey_motion.modelling.training import TrainedPrimitive, train_primitive
from marey_reports.models.figures import ModelSubject, draw_alignment_figures, draw_model_figures
from marey_reports.models.page import render_model_report
from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.reports import ModelReport
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.kinds import Kind
from marey_schemas.options.modelling import ModelOptions
from marey_schemas.queue.job_params import ModelParams
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput
from marey_schemas.validation.reasons import first_reason
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.matching_clips import refusing_motion_errors
from marey_worker.job_io.skeleton_cache import Rig, read_mapped
from marey_worker.job_io.stored_reports import inputs_of, store_report


def run(context: Context, params: ModelParams) -> dict[str, Any]:
    """Train a model on the aligned clips of the job and stage it.

    Raises `JobRefused` if the clips were not aligned together, or if no model can be trained on them.
    """
    started = time.monotonic()
    pins = context.inputs["aligned"]
    motions, infos = _read(context, pins)
    skeleton = _common_skeleton(pins, motions)
    with refusing_motion_errors():
        aligned = _aligned(context, pins, skeleton, motions, infos)
        trained = train_primitive(
            aligned,
            ModelOptions.of(params),
            name=params.name,
            seed=context.seed,
            threads=context.threads,
            progress=context.progress,
        )
    origin = _provenance(context, pins, aligned, infos)
    tree = trained_to_tree(trained, skeleton.model_dump(), origin)
    parts = {"model": tree}
    if params.report:
        context.progress(0, None, "writing the report")
        check = _checked(context, trained, aligned, skeleton) if params.search_check else None
        parts["report"] = write_model_report(context, trained, aligned, origin, check)
    context.stage(
        [StagedOutput(name=params.name, kind=Kind.MODEL, item_name=params.name, tags=params.tags, parts=parts)]
    )
    return {
        "verdict": tree["verdict"],
        **tree["headline"],
        "notes": [warning.message for warning in trained.warnings],
        "training_s": round(time.monotonic() - started, 4),
    }


def _read(context: Context, pins: Sequence[PinnedInput]) -> tuple[list[MotionDocument], list[dict[str, Any]]]:
    """Return the parts `motion` and `info` of all aligned clips, in order.

    Raises `JobRefused` if an `info` is not valid.
    """
    motions, infos = [], []
    for done, (pin, tree) in enumerate(context.documents(pins, "motion")):
        context.progress(done, len(pins), f"reading {pin.name}")
        motions.append(MotionDocument.model_validate(tree))
    for pin, tree in context.documents(pins, "info"):
        try:
            AlignmentInfo.model_validate(tree)
        except ValidationError as error:
            raise JobRefused("bad-document", f"{pin.path}: {first_reason(error)}") from error
        infos.append(tree)
    return motions, infos


def _common_skeleton(pins: Sequence[PinnedInput], motions: Sequence[MotionDocument]) -> RevisionRef:
    """Return the skeleton that all clips have, at the newest revision in use.

    Raises `JobRefused` if the clips have several skeletons.
    """
    used = [RevisionRef.model_validate(motion.skeleton.model_dump()) for motion in motions]
    for pin, ref in zip(pins, used, strict=True):
        if ref.item != used[0].item:
            raise JobRefused(
                "several-skeletons",
                f"{pin.path} has another skeleton than {pins[0].path}; train the model on clips of one skeleton",
            )
    return max(used, key=lambda ref: ref.revision)


def _aligned(
    context: Context,
    pins: Sequence[PinnedInput],
    ref: RevisionRef,
    motions: Sequence[MotionDocument],
    infos: Sequence[dict[str, Any]],
) -> AlignedSet:
    hierarchy = context.document(Kind.SKELETON, ref.item, ref.revision, "hierarchy")
    skeleton = documents.skeleton_from_document(SkeletonHierarchy.model_validate(hierarchy))
    return set_from_examples(
        [
            StoredExample(uid_of(pin.item, pin.revision), documents.clip_from_document(motion, skeleton), info)
            for pin, motion, info in zip(pins, motions, infos, strict=True)
        ]
    )


def _provenance(
    context: Context, pins: Sequence[PinnedInput], aligned: AlignedSet, infos: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Return the field `provenance` of the part `model`: the aligned clips, the reference and the seed."""
    return {
        "aligned": [{"item": pin.item, "revision": pin.revision, "name": pin.path} for pin in pins],
        "set": infos[0].get("set"),
        "reference": aligned.reference,
        "seed": context.seed,
    }


def write_model_report(
    context: Context,
    trained: TrainedPrimitive,
    aligned: AlignedSet,
    origin: Mapping[str, Any],
    check: SearchCheck | None,
) -> dict[str, Any]:
    """Draw the figures of a model and of its alignment, and write the report page with them.

    Return the document that refers to the stored page and figures.

    Parameters
    ----------
    origin : field `provenance` of the part `model`: the clips, reference and seed from which the model was trained
    check : errors of searches for targets that examples reached; None: the page shows none
    """
    title = trained.primitive.name
    subject = ModelSubject(trained.primitive, aligned, trained.report, check, context.seed)
    figures = {**draw_alignment_figures(aligned), **draw_model_figures(subject)}
    page = render_model_report(trained, subject, figures, title=title, origin=origin, inputs=inputs_of(context))
    return store_report(context, ModelReport, title, page, ((None, figure) for figure in figures.values()))


def _checked(context: Context, trained: TrainedPrimitive, aligned: AlignedSet, ref: RevisionRef) -> SearchCheck | None:
    context.progress(0, None, "searching for targets that the examples reached")
    try:
        mapped = read_mapped(context, Rig.as_stored(ref))
    except MappingError:  # a model needs no joint mapping, but without one hands and feet are unknown
        return None
    joints = {standard: mapped.skeleton.index_of(name) for standard, name in mapped.mapping.joints.items()}
    return check_search(aligned, joints, trained.options, seed=context.seed)

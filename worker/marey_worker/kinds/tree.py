"""Kind `tree`: builds a search tree over samples of a model, with which searches find motions faster."""

from __future__ import annotations

import time
from typing import Any

from marey_motion.modelling.primitive_documents import primitive_from_tree
from marey_motion.modelling.search.tree import END_EFFECTORS, build_tree
from marey_motion.modelling.search.tree_documents import sample_tree_to_tree
from marey_schemas.documents.references import RevisionRef
from marey_schemas.encoding.canonical import document_digest
from marey_schemas.kinds import Kind
from marey_schemas.options.modelling import TreeOptions
from marey_schemas.queue.job_params import TreeParams
from marey_schemas.queue.jobs import ItemInput
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.matching_clips import refusing_motion_errors
from marey_worker.job_io.skeleton_cache import Rig, read_mapped


def run(context: Context, params: TreeParams) -> dict[str, Any]:
    """Build a search tree over samples of a model, and stage it as a part of the model; other parts are unchanged.

    Raises `JobRefused` if the tree cannot be built, if the model was moved or renamed while the job waited, or if the
    job names a folder for the result, because the result is stored with the model.
    """
    started = time.monotonic()
    (pin,) = context.inputs["model"]
    if (unclear := params.unclear_place(context.into)) is not None:
        raise JobRefused("ambiguous-place", unclear)
    _require_same_place(context, pin)
    context.progress(0, 2, "reading the model")
    model = context.document(Kind.MODEL, pin.item, pin.revision, "model")
    options = TreeOptions.of(params)
    with refusing_motion_errors():
        skeleton, mapping, *_axes = read_mapped(context, Rig.as_stored(RevisionRef.model_validate(model["skeleton"])))
        primitive = primitive_from_tree(model, skeleton)
        known = [name for name in END_EFFECTORS if name in mapping.joints]
        context.progress(1, 2, "grouping samples")
        tree = build_tree(primitive, context.seed, options, end_effectors=mapping.indices(skeleton, known))
    part = sample_tree_to_tree(tree, model_digest=document_digest(model), seed=context.seed, options=options)
    _require_same_place(context, pin)
    context.stage(
        [
            StagedOutput(
                name=pin.name,
                kind=Kind.MODEL,
                item_name=pin.name,
                collection=pin.collection,
                parts={"tree": part},
                sources={"model": (ItemInput(item=pin.item, revision=pin.revision),)},
            )
        ]
    )
    return {
        "samples": len(tree.samples),
        "nodes": len(tree.sizes),
        "features": params.features,
        "seconds": round(time.monotonic() - started, 4),
    }


def _require_same_place(context: Context, pin: PinnedInput) -> None:
    """Raise `JobRefused` if the model was moved or renamed, because the result would then not be its next revision."""
    now = context.item(Kind.MODEL, pin.item)
    if (now.collection, now.name) != (pin.collection, pin.name):
        raise JobRefused("model-moved", f"{pin.path} was moved or renamed while the job waited; submit the job again")

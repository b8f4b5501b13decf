"""Evaluations and their sets of clips as inputs of jobs, and storage of the result files of these jobs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.result_documents import records_from_tree, result_from_tree
from marey_motion.evaluation.scenario import Trial
from marey_schemas.documents.reports import StoredFile
from marey_schemas.encoding.codecs import JSON, encode_tree
from marey_schemas.kinds import Kind
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import Context
from marey_worker.job_io.matching_clips import (
    ClipSet,
    MatchingClips,
    evaluated_clip_set,
    read_evaluated_clips,
    refusing_motion_errors,
)


@dataclass(frozen=True)
class EvaluatedSet:
    """Evaluation with the records of its trials, its clips, and a matching database of them with its normaliser."""

    result: EvaluationResult
    clip_set: ClipSet
    clips: MatchingClips

    @property
    def trials(self) -> tuple[Trial, ...]:
        """The trials of the evaluation."""
        return tuple(one.trial for one in self.result.trials)


def read_result(context: Context, pin: PinnedInput) -> tuple[EvaluationResult, Mapping[str, Any]]:
    """Return an evaluation with the records of its trials, and its document (part `evaluation`)."""
    document = context.document(Kind.EVALUATION, pin.item, pin.revision, "evaluation")
    records = records_from_tree(context.document(Kind.EVALUATION, pin.item, pin.revision, "records"))
    with refusing_motion_errors():
        return result_from_tree(document, tuple(records.values())), document


def read_evaluated_set(context: Context) -> EvaluatedSet:
    """Return the job's input `evaluation` with the matching database of its clips.

    Raises `JobRefused` if the clips cannot be used.
    """
    (pin,) = context.inputs["evaluation"]
    result, document = read_result(context, pin)
    clip_set = evaluated_clip_set(pin, document)
    clips = read_evaluated_clips(context, pin, clip_set, document, result.options.database)
    return EvaluatedSet(result, clip_set, clips)


def store_document(context: Context, tree: Mapping[str, Any]) -> dict[str, Any]:
    """Send a document as a JSON file; return an entry for the job's result, which refers to the file."""
    return store_file(context, encode_tree(tree, JSON))


def store_file(context: Context, data: bytes) -> dict[str, Any]:
    """Send a file to the server; return an entry for the job's result. The entry protects the file from deletion."""
    file = context.scratch / "document"
    file.write_bytes(data)
    return StoredFile(blob=context.put_file(file), size_bytes=len(data)).model_dump(mode="json")

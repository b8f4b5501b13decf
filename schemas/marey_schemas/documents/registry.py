"""Registry of document models by the name of their schema."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field, StringConstraints

from marey_schemas.base import Request
from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.clips import ClipInfo, MotionDocument
from marey_schemas.documents.evaluations import EvaluationDocument, EvaluationRecords
from marey_schemas.documents.graphs import ModelGraph
from marey_schemas.documents.metrics import MetricDocument
from marey_schemas.documents.models import MotionPrimitiveDocument
from marey_schemas.documents.motion_indexes import MotionIndexDocument
from marey_schemas.documents.predecessor_records import PredecessorRecord
from marey_schemas.documents.references import OutputRef as OutputRef
from marey_schemas.documents.references import RevisionRef as RevisionRef
from marey_schemas.documents.reports import EvaluationReport, ModelReport
from marey_schemas.documents.sample_trees import SampleTreeDocument
from marey_schemas.documents.skeletons import SkeletonHierarchy, SkeletonMapping
from marey_schemas.documents.studies import StudyDocument
from marey_schemas.editing.edits import EditDocument
from marey_schemas.names import form

_SCHEMA = form(
    r"^[a-z0-9][a-z0-9_-]*/[a-z0-9][a-z0-9_-]*@[1-9][0-9]*$", "name a schema and its version, as in lab/calibration@1"
)


class OpenDocument(Request):
    """Document without a fixed schema: it may have any members besides `schema`."""

    model_config = ConfigDict(extra="allow")

    schema_: Annotated[str, StringConstraints(pattern=_SCHEMA)] = Field("marey/document@1", alias="schema")


SCHEMAS: dict[str, type[Request]] = {
    model.model_fields["schema_"].default: model
    for model in (
        SkeletonHierarchy,
        SkeletonMapping,
        MotionDocument,
        ClipInfo,
        Annotation,
        EvaluationDocument,
        EvaluationRecords,
        EvaluationReport,
        EditDocument,
        AlignmentInfo,
        MotionPrimitiveDocument,
        SampleTreeDocument,
        ModelReport,
        ModelGraph,
        StudyDocument,
        MetricDocument,
        MotionIndexDocument,
        PredecessorRecord,
        OpenDocument,
    )
}
"""Pydantic models by the name of their schema."""

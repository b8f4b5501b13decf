"""Reports for people: a page and its figures, as a part of an evaluation or a model."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from marey_schemas.base import Request
from marey_schemas.names import Digest, TrialName, form

ScriptDigest = Annotated[
    str, StringConstraints(pattern=form(r"^sha256-[A-Za-z0-9+/]{43}=$", "be sha256- and a digest in Base64"))
]
"""Digest of a script, in the syntax of Content-Security-Policy."""

_FIGURE = form(
    r"^[a-z0-9][a-z0-9_-]{0,63}$",
    "have at most 64 lower-case letters, digits, - and _, and begin with a letter or digit",
)
FigureName = Annotated[str, StringConstraints(pattern=_FIGURE)]


class StoredFile(Request):
    """File that is stored as a blob: its digest and its size."""

    blob: Digest
    size_bytes: int = Field(ge=0)


class StoredFigure(Request):
    """Figure in all its formats: image, vector drawing, and its data as one JSON file and as CSV tables."""

    name: FigureName
    number: str = Field("", description="Number of the same figure in a published paper; empty: none.")
    title: str
    caption: str
    trial: TrialName | None = Field(
        None,
        description="The trial that the figure was requested for; null for figures of the worst trial or of all "
        "trials.",
    )
    png: StoredFile
    svg: StoredFile
    json_: StoredFile = Field(alias="json")
    csv: dict[str, StoredFile] = Field(
        default_factory=dict, max_length=64, description="Tables of the plotted data, by name."
    )


class Report(Request):
    """HTML page of a report, and its figures."""

    schema_: str = Field(alias="schema")
    title: str
    html: StoredFile
    scripts: tuple[ScriptDigest, ...] = Field(
        (), max_length=16, description="Hashes of the scripts that the page may run."
    )
    figures: tuple[StoredFigure, ...] = Field((), max_length=10_000)


class EvaluationReport(Report):
    """Part `report` of an evaluation: the HTML page and its figures."""

    schema_: Literal["marey/evaluation-report@1"] = Field("marey/evaluation-report@1", alias="schema")


class ModelReport(Report):
    """Part `report` of a model: its quality, and the alignment of its examples."""

    schema_: Literal["marey/model-report@1"] = Field("marey/model-report@1", alias="schema")


REPORTS: tuple[type[Report], ...] = (EvaluationReport, ModelReport)

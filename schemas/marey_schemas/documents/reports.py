"""Reports for people: one page and its figures, as part of an evaluation or of a model."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from marey_schemas.base import Request
from marey_schemas.names import Digest, TrialName

ScriptDigest = Annotated[str, StringConstraints(pattern=r"^sha256-[A-Za-z0-9+/]{43}=$")]
"""A script by its content, as a Content-Security-Policy names it."""

FigureName = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]


class StoredFile(Request):
    """A file that a document names."""

    blob: Digest
    size_bytes: int = Field(ge=0)


class StoredFigure(Request):
    """A figure in each of its forms: picture, drawing, and what is plotted, as one JSON and as tables of CSV."""

    name: FigureName
    number: str = Field("", description="The corresponding figure of the publication.")
    title: str
    caption: str
    trial: TrialName | None = Field(
        None, description="The trial that the figure was requested for; null for figures of the worst trial or of all."
    )
    png: StoredFile
    svg: StoredFile
    json_: StoredFile = Field(alias="json")
    csv: dict[str, StoredFile] = Field(
        default_factory=dict, max_length=64, description="Tables of the plotted data, by name."
    )


class Report(Request):
    """One page for people, and its figures."""

    schema_: str = Field(alias="schema")
    title: str
    html: StoredFile
    scripts: tuple[ScriptDigest, ...] = Field(
        (), max_length=16, description="Hashes of the scripts that the page may run."
    )
    figures: tuple[StoredFigure, ...] = Field((), max_length=10_000)


class EvaluationReport(Report):
    """Part `report` of an evaluation."""

    schema_: Literal["marey/evaluation-report@1"] = Field("marey/evaluation-report@1", alias="schema")


class ModelReport(Report):
    """Part `report` of a model: how good it is, and how its examples were aligned."""

    schema_: Literal["marey/model-report@1"] = Field("marey/model-report@1", alias="schema")


REPORTS: tuple[type[Report], ...] = (EvaluationReport, ModelReport)

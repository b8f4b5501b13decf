"""Sidecar of an exported folder: which version of which dataset it contains, and where each clip comes from."""

from __future__ import annotations

from typing import Literal

from pydantic import ConfigDict, Field

from marey_schemas.base import Answer
from marey_schemas.datasets.layouts import Layout
from marey_schemas.documents.clips import RecordingFacts

EXPORT_SCHEMA = "marey/export@1"
SIDECAR = "marey.json"
"""Name of the sidecar, at the top of an exported folder."""


class ExportedRecord(RecordingFacts):
    """Facts about the recording of an exported clip. Unknown fields are ignored, as in answers."""

    model_config = ConfigDict(extra="ignore")


class ExportedSource(Answer):
    """File from which an exported clip was imported: its name, digest and format."""

    name: str | None = None
    digest: str
    format: str | None = None


class ExportedInput(Answer):
    """Revision that was an input of the job that made a clip; all ids are those of the server that made the export."""

    role: str = Field(description="Name of the job input for which the revision was used.")
    kind: str
    item: str
    revision: int


class ExportedJob(Answer):
    """Job that made an exported clip, with its inputs."""

    id: str
    kind: str
    seed: int
    code_versions: tuple[str, ...] = ()
    commits: tuple[str, ...] = Field((), description="Digests of the commits from which the job took its inputs.")
    inputs: tuple[ExportedInput, ...] = ()


class ExportedClip(Answer):
    """Clip of an exported version, with its file, its take record and its origin."""

    path: str = Field(description="Path of the entry in the version.")
    content: str = Field(
        description="Content digest of the revision. Equal revisions have the same digest on every server."
    )
    file: str | None = Field(
        None,
        description="Path of the clip's file in the exported folder; null: an episode of the dataset contains "
        "the clip's frames.",
    )
    digest: str | None = Field(None, description="Digest of the bytes of `file`; null if the clip has no file.")
    episode: int | None = Field(
        None, description="Index of the clip's episode in a LeRobotDataset; null in other layouts."
    )
    tags: tuple[str, ...] = ()
    record: ExportedRecord = ExportedRecord()
    source: ExportedSource | None = None
    job: ExportedJob | None = None


class ExportedIdentity(Answer):
    """Version that an exported folder contains. Its digest, `commit`, identifies the version on every server."""

    dataset: str
    commit: str
    tag: str | None = Field(
        None, description="Tag that the request for the export gave as the version; null: the request gave no tag."
    )
    folder: str = Field("", description="Folder of the version to which the export was limited.")
    author: str
    at: str
    message: str


class ExportedFolder(ExportedIdentity):
    """The sidecar `marey.json` of an exported folder: the version, the files, and the description of each clip."""

    schema_: Literal["marey/export@1"] = Field(alias="schema")
    layout: Layout
    format: str | None = Field(None, description="Format of the motion files; null in a LeRobotDataset.")
    unit: str | None = Field(None, description="Unit of length in the motion files; null in a LeRobotDataset.")
    licences: tuple[str, ...] = Field((), description="Different licences in the take records of the clips.")
    clips: tuple[ExportedClip, ...] = ()

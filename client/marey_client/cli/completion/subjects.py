"""Table of the completion functions of parameters. Typer completes choices and files by itself; they need no entry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from marey_client.cli.completion.found import (
    How,
    any_of,
    branches,
    commit_targets,
    datasets,
    entries,
    in_project,
    job_kinds,
    jobs,
    listed_in,
    members,
    nothing,
    one_of,
    paths,
    places,
    places_or_versions,
    projects,
    proposals,
    refs,
    several_listed_in,
    users,
    versions,
)
from marey_schemas.formats import EXPORT_FORMATS, MOTION_FORMATS, SAMPLE_FORMATS, WRITTEN_UNITS
from marey_schemas.kinds import Kind

_CLIPS = places_or_versions(Kind.CLIP)
_ANY = places(*Kind)
_KINDS = one_of(*Kind)
_KINDS_OR_FOLDERS = one_of(*Kind, "collection")
_METRICS = any_of(listed_in("marey_schemas.documents.metrics:built_in_names"), places(Kind.METRIC))
_ANNOTATIONS = places(Kind.ANNOTATION)
_EVALUATIONS = places(Kind.EVALUATION)
_MODELS = places(Kind.MODEL)
_FOLDERS = places()
_STUDIES = places(Kind.STUDY)
_SCRIPTS = in_project("scripts", remark="description")
_SCHEDULES = in_project("schedules", remark="description")
_UNITS = one_of(*WRITTEN_UNITS)


SUBJECTS: Mapping[str, How] = {
    # parameters with this name, of all commands
    "project": projects,
    "project_name": projects,
    "projects": projects,
    "job_id": jobs(),
    "sources": _CLIPS,
    "clip": places(Kind.CLIP),
    "into": paths(),
    "evaluation": _EVALUATIONS,
    "normaliser": _EVALUATIONS,
    "metric": _METRICS,
    "loop": _CLIPS,
    "candidates": _CLIPS,
    "chosen__commit_to": commit_targets,
    "chosen__collection": paths(),
    "role": listed_in("marey_schemas.access:Role"),
    # parameters of single commands, or of groups of commands
    "align annotations": _ANNOTATIONS,
    "align chosen__reference": any_of(listed_in("marey_client.cli.clip_jobs:REFERENCES"), places(Kind.CLIP)),
    "annotation place": _ANNOTATIONS,
    "archive create place": versions,
    "archive import place": datasets,
    "archive since": refs,
    "audit actor": users,
    "build-model takes": _CLIPS,
    "build-model to": places(Kind.SKELETON),
    "compare before": _EVALUATIONS,
    "compare others": _EVALUATIONS,
    "cut sources": _ANNOTATIONS,
    "dataset after": refs,
    "dataset bad": refs,
    "dataset bisect into": paths(),
    "dataset bisect metric": nothing,
    "dataset bisect place": datasets,
    "dataset branch": branches,
    "dataset commit place": datasets,
    "dataset create folder": paths(),
    "dataset create place": datasets,
    "dataset format": one_of(*MOTION_FORMATS),
    "dataset good": refs,
    "dataset into": branches,
    "dataset kind": _KINDS,
    "dataset path": entries,
    "dataset place": versions,
    "dataset refs place": datasets,
    "dataset reset name": branches,
    "dataset target": datasets,
    "dataset unit": _UNITS,
    "diff after": _ANY,
    "diff before": _ANY,
    "download format": one_of(*EXPORT_FORMATS),
    "download place": places_or_versions(*Kind),
    "download unit": _UNITS,
    "edit address": places(Kind.CLIP, Kind.EDIT),
    "edit saved": places(Kind.EDIT),
    "job cancel job_id": jobs("waiting", "queued", "running"),
    "job kind": job_kinds,
    "job kinds name": job_kinds,
    "job retry job_id": jobs("failed", "cancelled"),
    "job state": listed_in("marey_schemas.queue.jobs:JobState"),
    "lineage place": _ANY,
    "ls columns": several_listed_in("marey_client.cli.files.listing:COLUMNS"),
    "ls kind": _KINDS,
    "ls place": _ANY,
    "member user": members,
    "member put user": users,
    "metric compare sources": _CLIPS,
    "metric into": _FOLDERS,
    "metric name": _METRICS,
    "metric place": _FOLDERS,
    "model sources": places(Kind.PROCESSED),
    "mv kind": _KINDS_OR_FOLDERS,
    "mv places": _ANY,
    "project name": projects,
    "project create name": nothing,
    "project restore name": nothing,
    "proposal into": branches,
    "proposal number": proposals,
    "proposal open place": versions,
    "proposal place": datasets,
    "purge kind": _KINDS,
    "purge places": _ANY,
    "quality against": jobs("succeeded"),
    "quality contacts": _ANNOTATIONS,
    "quality reference": _CLIPS,
    "record place": places(Kind.CLIP),
    "report place": places(Kind.EVALUATION, Kind.MODEL),
    "restore kind": _KINDS_OR_FOLDERS,
    "restore places": _FOLDERS,
    "retarget to": places(Kind.SKELETON),
    "revert place": _ANY,
    "rm kind": _KINDS_OR_FOLDERS,
    "rm places": _ANY,
    "sample format": one_of(*SAMPLE_FORMATS),
    "sample place": _MODELS,
    "sample unit": _UNITS,
    "schedule name": _SCHEDULES,
    "schedule create name": nothing,
    "script name": _SCRIPTS,
    "search place": _MODELS,
    "search format": one_of(*MOTION_FORMATS),
    "show place": _ANY,
    "similar example": places(Kind.CLIP),
    "similar at_index": places(Kind.INDEX),
    "skeleton keep": places(Kind.SKELETON),
    "skeleton place": places(Kind.SKELETON),
    "skeleton places": places(Kind.SKELETON),
    "stale place": _FOLDERS,
    "study analyse metric": nothing,
    "study place": _STUDIES,
    "tag kind": _KINDS,
    "tag places": _ANY,
    "token user": users,
    "token all_of": users,
    "tree place": _MODELS,
    "upload chosen__skeleton": places(Kind.SKELETON),
    "user name": users,
    "user create name": nothing,
    "view beside": places(Kind.CLIP),
    "view place": places(Kind.CLIP),
    "webhook webhook_id": in_project("webhooks", field="id", remark="url"),
}
"""Completion functions by `parameter`, `group parameter` or `command parameter`; the longest matching key is used."""


def how_to_complete(command: Sequence[str], parameter: str) -> How | None:
    """Return the completion function for a parameter of a command, such as `("job", "show")`; None if it has none."""
    keys = [" ".join([*command[:length], parameter]) for length in range(len(command), -1, -1)]
    return next((SUBJECTS[key] for key in keys if key in SUBJECTS), None)

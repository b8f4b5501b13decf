"""Lineage as a graph: revisions, the jobs that created them, and the commits from which the jobs took inputs."""

from __future__ import annotations

from collections import Counter
from datetime import datetime
from posixpath import commonpath
from typing import Literal, NamedTuple

from pydantic import Field

from marey_schemas.base import Answer, Options
from marey_schemas.kinds import Kind
from marey_schemas.sizes import MOST_INTEGER
from marey_schemas.wording import counted

MOST_REVISIONS = 1000
"""Greatest number of revisions that a graph contains in each direction (inputs and results)."""
MOST_LINKS = 10_000
"""Greatest number of links that a graph contains in each direction (inputs and results)."""
MERGED = "merged"
"""Role of the inputs of a revision that a merge of two versions made: the revisions from which it has its parts."""
RESTORED = "restored"
"""Role of the input of a revision that a revert or a checkout made: a revision with the same content."""
CUT_OFF = (
    f"The graph is cut off: it has more than {MOST_REVISIONS:,} revisions or {MOST_LINKS:,} links in one direction. "
    "The nearest ones are shown."
)
"""Note that is shown with a graph that is not complete."""


class LineageOptions(Options):
    """Options of a lineage graph: its direction and its depth."""

    direction: Literal["inputs", "results", "both"] = Field(
        "both",
        description="`inputs`: the revisions from which the revision was made; `results`: the revisions that "
        "were made from it; `both`: inputs and results.",
    )
    depth: int = Field(
        MOST_REVISIONS,
        ge=1,
        le=MOST_REVISIONS,
        description="Greatest number of jobs between the revision whose lineage is shown and any other revision of the "
        "graph.",
    )


class LineageRequest(LineageOptions):
    """Query of a lineage graph: the revision it starts from, its direction and its depth."""

    revision: int | None = Field(None, ge=1, le=MOST_INTEGER, description="Revision to start from; absent: the newest.")


class LineageRevision(Answer):
    """A revision in a lineage graph."""

    item: str
    kind: Kind
    path: str = Field(description="Current folder and name of the item; empty if it was purged.")
    revision: int
    newest: int = Field(
        description="Newest revision of the item. If it is greater than `revision`, `revision` is outdated."
    )
    deleted: bool = False
    purged: bool = Field(
        False,
        description="Whether the item was purged: its content, name and tags were deleted for good, and only its place "
        "in the lineage is left.",
    )
    distance: int = Field(
        description="Number of jobs between the start and this revision: negative for inputs, positive for results."
    )
    job: str | None = Field(
        None,
        description="Job that created the revision; if a task created it, the parent job of the task; absent: no job "
        "created it.",
    )
    created_at: datetime


class LineageLink(Answer):
    """A revision that a job used in order to create another revision."""

    source: int = Field(description="Index, in `revisions`, of the revision that was used.")
    result: int = Field(description="Index, in `revisions`, of the revision that was created.")
    role: str = Field(
        description="Name of the job input for which the source was used. `merged` or `restored` if no job made the "
        "result, but a merge of versions, or a checkout or revert."
    )


class LineageJob(Answer):
    """A job that created revisions of a lineage graph."""

    id: str
    kind: str
    seed: int
    code_versions: tuple[str, ...] = Field((), description="Versions of the code that created the revisions.")
    commits: tuple[str, ...] = Field((), description="Digests of the commits from which the job took its inputs.")
    commit: str | None = Field(
        None, description="Digest of the commit that the job made of its outputs; absent: it made none."
    )
    finished_at: datetime | None = None


class LineageGraph(Answer):
    """Graph of the sources of a revision, or of the results made from it, through any number of jobs."""

    revisions: tuple[LineageRevision, ...] = Field(
        description="Revisions of the graph; the first is the revision from which the graph starts."
    )
    links: tuple[LineageLink, ...]
    jobs: tuple[LineageJob, ...]
    complete: bool = Field(description="False if the graph was cut off, because it has too many revisions or links.")


class LineageGroup(NamedTuple):
    """Revisions that are shown as one.

    They have one kind and one distance from the start, were created by one job, and were used by the same jobs for the
    same inputs.

    Parameters
    ----------
    revisions : indices into `LineageGraph.revisions`, in ascending order
    """

    revisions: tuple[int, ...]
    kind: Kind
    job: str | None


class GroupLink(NamedTuple):
    """Link between two groups of revisions: jobs used revisions of one group to create revisions of the other.

    Parameters
    ----------
    source, result : indices of the groups
    role : name of the job input for which the sources were used
    used : number of revisions of `source` that were used
    """

    source: int
    result: int
    role: str
    used: int


def grouped(graph: LineageGraph) -> tuple[list[LineageGroup], list[GroupLink]]:
    """Gather the revisions of a graph in groups, so that the lineage of hundreds of clips can be read.

    The first group contains only the revision that the graph starts from.
    """
    used_by: list[set[tuple[str, str | None]]] = [set() for _ in graph.revisions]
    for link in graph.links:
        used_by[link.source].add((link.role, graph.revisions[link.result].job))
    members: dict[object, list[int]] = {}
    for position, one in enumerate(graph.revisions):
        alike = (one.kind, one.job, frozenset(used_by[position]), one.distance)
        members.setdefault(alike if position else None, []).append(position)
    groups = [
        LineageGroup(tuple(positions), graph.revisions[positions[0]].kind, graph.revisions[positions[0]].job)
        for positions in members.values()
    ]
    group_of = {position: index for index, group in enumerate(groups) for position in group.revisions}
    used = {(link.source, group_of[link.result], link.role) for link in graph.links}
    counts = Counter((group_of[source], result, role) for source, result, role in used)
    return groups, [GroupLink(*key, count) for key, count in sorted(counts.items())]


def title_of(graph: LineageGraph, group: LineageGroup) -> str:
    """Return a title: "raw/walk@2" for one revision, "12 clips in raw" for several.

    A purged item has no path; its title is its id.
    """
    members = [graph.revisions[position] for position in group.revisions]
    if len(members) == 1:
        return f"{members[0].path or members[0].item}@{members[0].revision}"
    shared = commonpath([one.path.rpartition("/")[0] for one in members])
    return f"{counted(len(members), group.kind.noun)}{f' in {shared}' if shared else ''}"


def remarks_on(graph: LineageGraph, group: LineageGroup) -> list[str]:
    """Return remarks about the revisions of a group: how many of them are outdated, deleted and purged."""
    members = [graph.revisions[position] for position in group.revisions]
    purged = [one for one in members if one.purged]
    old = [one for one in members if one.newest > one.revision and not one.purged]
    deleted = [one for one in members if one.deleted and not one.purged]
    if len(members) == 1:
        return [f"newest: {one.newest}" for one in old] + ["deleted" for _ in deleted] + ["purged" for _ in purged]
    counts = (
        (len(old), "with a newer revision" if len(old) == 1 else "with newer revisions"),
        (len(deleted), "deleted"),
        (len(purged), "purged"),
    )
    return [f"{count} {what}" for count, what in counts if count]

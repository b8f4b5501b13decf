"""Boxes and arrows of a lineage graph: groups of revisions, the jobs between them, and the commits of their inputs."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

from marey_reports.drawing.paper import plain, shortened
from marey_schemas.lineage import GroupLink, LineageGraph, LineageGroup, LineageJob, grouped, remarks_on, title_of

LONGEST_LINE = 44
"""Greatest length of a line in a box, in characters; longer lines are shortened in their middle."""
MOST_NAMES = 3
"""Greatest number of names that a box of several revisions lists."""


class Sort(StrEnum):
    """Kind of a box: the revision from which the graph starts, other revisions, a job or a commit."""

    START = "start"
    ITEMS = "items"
    JOB = "job"
    COMMIT = "commit"


class Box(NamedTuple):
    """Box of the picture with its lines of text; `warning`: whether a revision in it is outdated, deleted or purged."""

    sort: Sort
    lines: tuple[str, ...]
    warning: bool = False


class Arrow(NamedTuple):
    """Arrow with a label between two boxes; the boxes are given by index."""

    source: int
    target: int
    label: str = ""


def boxes_of(graph: LineageGraph) -> tuple[list[Box], list[Arrow]]:
    """Return the boxes of a graph and the arrows between them; the first box is the revision where the graph starts."""
    groups, links = grouped(graph)
    boxes = [_group_box(graph, group, start=index == 0) for index, group in enumerate(groups)]
    arrows: list[Arrow] = []
    made_by = {group.job for group in groups}
    jobs = [job for job in graph.jobs if job.id in made_by]
    commits = sorted({commit for job in jobs for commit in (*job.commits, job.commit) if commit is not None})
    job_boxes = {job.id: len(boxes) + index for index, job in enumerate(jobs)}
    boxes += map(_job_box, jobs)
    commit_boxes = {commit: len(boxes) + index for index, commit in enumerate(commits)}
    boxes += (Box(Sort.COMMIT, (f"commit {commit.rpartition(':')[2][:12]}",)) for commit in commits)
    arrows += (Arrow(commit_boxes[commit], job_boxes[job.id]) for job in jobs for commit in job.commits)
    arrows += (Arrow(job_boxes[job.id], commit_boxes[job.commit]) for job in jobs if job.commit is not None)
    arrows += (Arrow(job_boxes[group.job], index) for index, group in enumerate(groups) if group.job in job_boxes)
    arrows += dict.fromkeys(_into(link, groups, job_boxes) for link in links)
    return boxes, arrows


def _into(link: GroupLink, groups: list[LineageGroup], job_boxes: dict[str, int]) -> Arrow:
    """Return the arrow of a link: from its source to the job that made the result, or without a job, to the result."""
    return Arrow(link.source, job_boxes.get(groups[link.result].job or "", link.result), _line(link.role))


def _group_box(graph: LineageGraph, group: LineageGroup, *, start: bool) -> Box:
    remarks = remarks_on(graph, group)
    lines = [title_of(graph, group)]
    if len(group.revisions) == 1:
        lines.append(group.kind.value)
    else:
        paths = sorted(graph.revisions[position].path for position in group.revisions)
        lines += [path.rpartition("/")[2] for path in paths[:MOST_NAMES]]
        lines += ["…"] if len(paths) > MOST_NAMES else []
    lines += remarks
    return Box(Sort.START if start else Sort.ITEMS, tuple(map(_line, lines)), bool(remarks))


def _job_box(job: LineageJob) -> Box:
    finished = "" if job.finished_at is None else job.finished_at.strftime("%Y-%m-%d %H:%MZ")
    lines = (job.kind, job.id, f"seed {job.seed}", ", ".join(job.code_versions), finished)
    return Box(Sort.JOB, tuple(_line(line) for line in lines if line))


def _line(text: str) -> str:
    return shortened(plain(text), LONGEST_LINE)

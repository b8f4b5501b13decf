"""Command `lineage`: what an item was made from and what was made from it, as text, JSON or a picture."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from marey_client.cli.addresses import Address
from marey_client.cli.revisions import require_revision
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_schemas.formats.pictures import LINEAGE_FILES

if TYPE_CHECKING:
    from marey_schemas.lineage import GroupLink, LineageGraph, LineageJob


def add_to(app: typer.Typer) -> None:
    """Add the command of this module to the application `app`."""
    add_command(app, lineage, params=OptionsOf("marey_schemas.lineage:LineageOptions"))


def lineage(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="Item, or one of its revisions: project/folder/name[@revision].")],
    params: Chosen,
    picture: Annotated[
        Path | None, typer.Option(help="Draw the graph to this file, which ends in .svg, .png or .dot (Graphviz).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show what an item was made from and what was made from it: items, jobs and commits."""
    if picture is not None and picture.suffix.lower().lstrip(".") not in LINEAGE_FILES:
        raise WrongUsage(f"{picture} must end in .svg, .png or .dot")
    from marey_schemas.kinds import Kind

    with connect(context) as marey:
        item, revision = require_revision(marey, Address.parse(place), list(Kind))
        graph = item.lineage_graph(revision, **params)
    if picture is not None:
        _draw(graph, picture)
    if as_json:
        return print_json(graph)
    return typer.echo("\n".join(described(graph)))


def _draw(graph: LineageGraph, picture: Path) -> None:
    from marey_client import embedded
    from marey_client.downloads import write_whole

    write_whole(picture, embedded.draw_lineage(graph, picture.suffix.lower().lstrip(".")))
    print_message(f"wrote {picture}")


def described(graph: LineageGraph) -> Iterator[str]:
    """Yield the lines of an indented text that describes a graph, from the revision where the graph starts."""
    return _LineageTree(graph).lines()


_Branch: TypeAlias = "Iterator[str | _Branch]"
"""Iterator over the lines of a tree; an element is a line, or a branch: an iterator over further lines."""


class _LineageTree:
    """Lineage graph as indented text: first the inputs of the revision where the graph starts, then its results.

    Revisions of one kind that one job created, and that the same jobs used, are listed as one group. If a group occurs
    several times, its inputs or results are listed only the first time.
    """

    def __init__(self, graph: LineageGraph) -> None:
        from marey_schemas.lineage import grouped

        self._graph = graph
        self._groups, links = grouped(graph)
        self._jobs = {one.id: one for one in graph.jobs}
        self._inputs: dict[int, list[GroupLink]] = defaultdict(list)
        self._results: dict[int, list[GroupLink]] = defaultdict(list)
        for link in links:
            self._inputs[link.result].append(link)
            self._results[link.source].append(link)
        self._unfolded: set[tuple[int, bool]] = set()

    def lines(self) -> Iterator[str]:
        """Yield the lines. An explicit stack replaces recursion, because a graph may be 1,000 jobs deep."""
        branches = [self._whole()]
        while branches:
            step = next(branches[-1], None)
            if step is None:
                branches.pop()
            elif isinstance(step, str):
                yield step
            else:
                branches.append(step)

    def _whole(self) -> _Branch:
        from marey_schemas.lineage import CUT_OFF

        yield self._named(0)
        yield self._made_from(0, "  ")
        yield self._used_for(0, "  ")
        if not self._graph.complete:
            yield CUT_OFF

    def _made_from(self, group: int, indent: str) -> _Branch:
        self._unfolded.add((group, True))
        if self._groups[group].job is not None or self._inputs[group]:
            yield f"{indent}made by {self._job(group)}"
        for link in self._inputs[group]:
            again = self._seen_before(link.source, inputs=True)
            of_many = len(self._groups[link.source].revisions)
            part = f", {link.used} of them" if link.used < of_many else ""
            yield f"{indent}  {link.role}: {self._named(link.source)}{part}{again}"
            if not again:
                yield self._made_from(link.source, f"{indent}    ")

    def _used_for(self, group: int, indent: str) -> _Branch:
        self._unfolded.add((group, False))
        for link in self._results[group]:
            again = self._seen_before(link.result, inputs=False)
            yield f"{indent}used as {link.role} by {self._job(link.result)}"
            yield f"{indent}  made {self._named(link.result)}{again}"
            if not again:
                yield self._used_for(link.result, f"{indent}    ")

    def _seen_before(self, group: int, *, inputs: bool) -> str:
        follows = self._inputs[group] if inputs else self._results[group]
        return " (see above)" if (group, inputs) in self._unfolded and follows else ""

    def _named(self, group: int) -> str:
        from marey_schemas.lineage import remarks_on, title_of

        one = self._groups[group]
        kind = [one.kind.value] if len(one.revisions) == 1 else []
        remarks = "; ".join([*kind, *remarks_on(self._graph, one)])
        return title_of(self._graph, one) + (f" ({remarks})" if remarks else "")

    def _job(self, group: int) -> str:
        job = self._jobs.get(self._groups[group].job or "")
        return "no job" if job is None else ", ".join(_job_words(job))


def _job_words(job: LineageJob) -> Iterator[str]:
    yield f"{job.kind} {job.id}"
    yield f"seed {job.seed}"
    yield from job.code_versions
    for commit in job.commits:
        yield f"inputs of commit {commit.rpartition(':')[2][:12]}"
    if job.commit is not None:
        yield f"results in commit {job.commit.rpartition(':')[2][:12]}"

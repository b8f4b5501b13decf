"""Lineage graphs as text, in which each group is listed once with its branches, at any depth."""

from __future__ import annotations

from datetime import UTC, datetime

from marey_client.cli.lineage import described
from marey_schemas.kinds import Kind
from marey_schemas.lineage import CUT_OFF, MOST_REVISIONS, LineageGraph, LineageJob, LineageLink, LineageRevision

TIME = datetime(2026, 5, 4, tzinfo=UTC)


def revision(path: str, distance: int, number: int = 1, newest: int = 1, job: str | None = None) -> LineageRevision:
    return LineageRevision(
        item=path,
        kind=Kind.CLIP,
        path=path,
        revision=number,
        newest=newest,
        distance=distance,
        job=job,
        created_at=TIME,
    )


def job(name: str) -> LineageJob:
    return LineageJob(id=name, kind="edit", seed=0)


def links(*pairs: tuple[int, int]) -> tuple[LineageLink, ...]:
    return tuple(LineageLink(source=source, result=result, role="clips") for source, result in pairs)


def test_what_several_jobs_used_is_unfolded_once() -> None:
    graph = LineageGraph(
        revisions=(
            revision("end", 0, job="job_c"), revision("left", -1, job="job_a"), revision("right", -1, job="job_b"),
            revision("middle", -2, job="job_0", newest=3), revision("raw", -3),
        ),
        links=links((1, 0), (2, 0), (3, 1), (3, 2), (4, 3)),
        jobs=tuple(map(job, ("job_0", "job_a", "job_b", "job_c"))),
        complete=False,
    )  # fmt: skip
    assert list(described(graph)) == [
        "end@1 (clip)",
        "  made by edit job_c, seed 0",
        "    clips: left@1 (clip)",
        "      made by edit job_a, seed 0",
        "        clips: middle@1 (clip; newest: 3)",
        "          made by edit job_0, seed 0",
        "            clips: raw@1 (clip)",
        "    clips: right@1 (clip)",
        "      made by edit job_b, seed 0",
        "        clips: middle@1 (clip; newest: 3) (see above)",
        CUT_OFF,
    ]


def test_results_name_the_jobs_that_used_them_and_the_number_of_inputs_of_a_group() -> None:
    graph = LineageGraph(
        revisions=(revision("raw", 0), revision("a/1", 1, job="job_a"), revision("a/2", 1, job="job_a"),
                   revision("cut", 2, job="job_b")),
        links=links((0, 1), (0, 2), (1, 3), (2, 3)),
        jobs=(job("job_a"),),
        complete=True,
    )  # fmt: skip
    assert list(described(graph)) == [
        "raw@1 (clip)",
        "  used as clips by edit job_a, seed 0",
        "    made 2 clips in a",
        "      used as clips by no job",
        "        made cut@1 (clip)",
    ]


def test_a_clip_that_was_edited_a_thousand_times_is_shown_whole() -> None:
    graph = LineageGraph(
        revisions=tuple(revision("walk", -place, MOST_REVISIONS + 1 - place) for place in range(MOST_REVISIONS + 1)),
        links=links(*((place + 1, place) for place in range(MOST_REVISIONS))),
        jobs=(),
        complete=True,
    )
    lines = list(described(graph))
    assert lines[-1].strip() == "clips: walk@1 (clip)"
    assert len(lines) == 1 + 2 * MOST_REVISIONS

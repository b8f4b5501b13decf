"""Lineage graphs: sources of revisions through any number of steps, within limits and rights."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.support.store_fixtures import ALL_RIGHTS, Lab
from tests.support.tiers import examples

from marey_schemas.kinds import Kind
from marey_schemas.lineage import LineageGraph, LineageRequest, grouped
from marey_server.errors import NotFoundProblem
from marey_server.store import items, projects
from marey_server.store.items import Draft, lineage_graphs
from marey_server.store.items.drafts import Published
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

Edges = Collection[tuple[int, int]]


def study(lab: Lab, name: str, *sources: Published, role: str = "of", content: object = 1) -> Published:
    """Publish a revision of a study with other items as sources, and return it."""
    draft = Draft(
        name, Kind.CHARACTER, name, {"character": {"of": name, "content": content}}, reuse="by_name",
        sources={role: [(one.item, one.revision) for one in sources]},
    )  # fmt: skip

    def publish(tx: Transaction) -> list[Published]:
        return items.publish(
            tx, projects.require(tx, lab.name), [draft], author_id=tx.principal.user_id, rights=ALL_RIGHTS
        )

    made: list[Published] = lab.write(publish)
    return made[0]


def graph_of(lab: Lab, one: Published, **kwargs: Any) -> LineageGraph:
    found: LineageGraph = lab.read(
        items.read_lineage_graph, lab.name, Kind.CHARACTER, one.item, LineageRequest(revision=one.revision, **kwargs)
    )
    return found


def named_links(graph: LineageGraph) -> set[tuple[str, str, str]]:
    names = [one.path for one in graph.revisions]
    return {(names[link.source], names[link.result], link.role) for link in graph.links}


def test_a_graph_reaches_through_any_number_of_steps_in_both_directions(lab: Lab) -> None:
    raw, other = study(lab, "raw"), study(lab, "other")
    cut = study(lab, "cut", raw, other, role="clips")
    model = study(lab, "model", cut)
    report = study(lab, "report", model, cut)
    study(lab, "cousin", raw)

    graph = graph_of(lab, cut)

    assert {one.path: one.distance for one in graph.revisions} == {
        "cut": 0, "raw": -1, "other": -1, "model": 1, "report": 1,
    }  # fmt: skip
    assert named_links(graph) == {
        ("raw", "cut", "clips"), ("other", "cut", "clips"), ("cut", "model", "of"), ("cut", "report", "of"),
        ("model", "report", "of"),
    }  # fmt: skip
    assert graph.complete
    assert graph.revisions[0].item == cut.item
    assert {one.path for one in graph_of(lab, report, direction="inputs").revisions} == {
        "report", "model", "cut", "raw", "other",
    }  # fmt: skip
    assert {one.path for one in graph_of(lab, raw, direction="results", depth=1).revisions} == {
        "raw", "cut", "cousin",
    }  # fmt: skip


def test_a_graph_starts_from_one_revision_and_names_newer_and_deleted_ones(lab: Lab) -> None:
    raw = study(lab, "raw")
    first = study(lab, "cut", raw)
    newer = study(lab, "raw", content=2)
    second = study(lab, "cut", newer, content=2)
    lab.write(items.delete_item, "lab", Kind.CHARACTER, raw.item, expected_rev=None)

    (start, source) = graph_of(lab, first).revisions

    assert (start.revision, start.newest, start.deleted) == (1, 2, False)
    assert (source.revision, source.newest, source.deleted) == (1, 2, True)
    assert graph_of(lab, second).revisions[1].revision == 2
    with pytest.raises(NotFoundProblem, match="no revision 3"):
        graph_of(lab, replace(second, revision=3))


@settings(max_examples=examples(30), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(edges=st.sets(st.tuples(st.integers(0, 9), st.integers(0, 9)).filter(lambda edge: edge[0] < edge[1])))
def test_a_graph_holds_what_a_search_of_all_links_finds(lab: Lab, edges: Edges) -> None:
    made: list[Published] = []
    for number in range(10):
        sources = [made[source] for source, result in sorted(edges) if result == number]
        made.append(study(lab, f"{number}", *sources, content=sorted(edges)))
    for number, one in enumerate(made):
        graph = graph_of(lab, one)
        ancestors, descendants = reached(number, edges, -1), reached(number, edges, 1)
        expected = ancestors | {place: -steps for place, steps in descendants.items()}
        assert {int(found.path): -found.distance for found in graph.revisions} == expected
        within = [set(ancestors), set(descendants)]
        assert {(int(source), int(result)) for source, result, _ in named_links(graph)} == {
            (source, result) for source, result in edges if any(source in side and result in side for side in within)
        }


def reached(start: int, edges: Edges, step: int) -> dict[int, int]:
    """Return the nodes that can be reached from `start` in one direction of the edges, with their distances."""
    found = {start: 0}
    queue = [start]
    for one in queue:
        for source, result in sorted(edges):
            near, far = (source, result) if step > 0 else (result, source)
            if near == one and far not in found:
                found[far] = found[one] + 1
                queue.append(far)
    return found


def test_revisions_of_projects_that_the_caller_may_not_read_are_left_out(lab: Lab) -> None:
    other = Lab(lab.database, "other")
    secret = study(other, "secret")
    beyond = study(lab, "beyond", study(lab, "open"))
    middle = study(other, "middle", beyond)
    end = study(lab, "end", secret, middle)

    def read(who: Any) -> set[str]:
        graph = lab.read(items.read_lineage_graph, "lab", Kind.CHARACTER, end.item, LineageRequest(), who=who)
        return {one.path for one in graph.revisions}

    assert read(lab.reader) == {"end"}
    other.make_public()
    assert read(lab.reader) == {"end", "secret", "middle", "beyond", "open"}
    for who in (lab.stranger, lab.anonymous):
        with pytest.raises(NotFoundProblem):
            read(who)


def test_a_graph_is_cut_off_at_its_limits_and_says_so(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lineage_graphs, "MOST_REVISIONS", 4)
    raw = [study(lab, f"raw {number}") for number in range(4)]
    few, many = study(lab, "few", *raw), study(lab, "many", *raw, study(lab, "raw 4"))
    result = study(lab, "result", many)

    assert graph_of(lab, few).complete
    graph = graph_of(lab, many)
    assert not graph.complete
    assert [one.path for one in graph.revisions if one.distance > 0] == ["result"]
    assert len([one for one in graph.revisions if one.distance < 0]) == 4
    assert all(link.source < len(graph.revisions) for link in graph.links)
    monkeypatch.setattr(lineage_graphs, "MOST_LINKS", 3)
    assert not graph_of(lab, few).complete
    assert len(graph_of(lab, few).links) <= 3
    assert graph_of(lab, result, depth=1).complete


def test_revisions_that_were_made_and_used_in_the_same_way_are_a_group(lab: Lab) -> None:
    raw = [study(lab, f"raw {number}") for number in range(5)]
    rig = study(lab, "rig")
    model = study(lab, "model", *raw[1:], rig)
    report = study(lab, "report", model, raw[0])

    groups, links = grouped(graph_of(lab, report, direction="inputs"))

    sizes = [len(group.revisions) for group in groups]
    assert sizes == [1, 2, 5]
    assert {(link.source, link.result, link.used) for link in links} == {(1, 0, 2), (2, 1, 5)}

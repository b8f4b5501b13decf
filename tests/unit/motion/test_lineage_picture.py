"""Pictures of lineage graphs: readable at any size, the same bytes for the same graph, and safe for any name."""

from __future__ import annotations

import io
import re
import xml.etree.ElementTree as ElementTree
from datetime import UTC, datetime
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.image import imread
from tests.support.drawn_figures import cut_off

from marey_reports.drawing import paper
from marey_reports.lineage import layers, picture
from marey_reports.lineage.layers import lay_out
from marey_reports.lineage.picture import WARNING, draw_lineage
from marey_schemas.kinds import Kind
from marey_schemas.lineage import CUT_OFF, LineageGraph, LineageJob, LineageLink, LineageRevision

TIME = datetime(2026, 5, 4, 12, 0, tzinfo=UTC)
COMMIT = "sha256:" + "5b130f77dd83" + 52 * "0"


def revision(path: str, distance: int, **members: Any) -> LineageRevision:
    given: dict[str, Any] = {"kind": Kind.CLIP, "revision": 1, "newest": 1, **members}
    return LineageRevision(item=path, path=path, distance=distance, created_at=TIME, **given)


def graph_of(*revisions: LineageRevision, links: list[tuple[int, int]], **members: Any) -> LineageGraph:
    jobs = sorted({one.job for one in revisions if one.job is not None})
    return LineageGraph(
        revisions=revisions,
        links=tuple(LineageLink(source=source, result=result, role="clips") for source, result in links),
        jobs=tuple(
            LineageJob(
                id=job, kind="retarget", seed=3, commits=(COMMIT,), code_versions=("retarget@3",), finished_at=TIME
            )
            for job in jobs
        ),
        complete=members.get("complete", True),
    )  # fmt: skip


def retargeted(count: int, name: str = "walk", **members: Any) -> LineageGraph:
    """Return the lineage of an evaluation of `count` retargeted clips, the first of which is outdated."""
    raw = [revision(f"raw/{name} {place}", -2, newest=1 + (place == 0)) for place in range(count)]
    results = [revision(f"target/{name} {place}", -1, job="job_retarget") for place in range(count)]
    start = revision(f"{name} report", 0, kind=Kind.EVALUATION, job="job_evaluate")
    links = [(1 + count + place, 1 + place) for place in range(count)] + [(1 + place, 0) for place in range(count)]
    return graph_of(start, *results, *raw, links=links, **members)


GRAPHS = {
    "one item": graph_of(revision("walk", 0), links=[]),
    "two clips": retargeted(2),
    "hundreds of clips": retargeted(300),
    "names with signs": retargeted(1, name="$x_1$ <&>\"'\\ ]]> \n \x07 " + "long " * 30),
    "without jobs": graph_of(revision("walk", 0), revision("raw", -1, deleted=True), links=[(1, 0)]),
    "cut off": retargeted(3, complete=False),
    "a chain": graph_of(
        *(revision(f"{place}", -place, job=f"job_{place}") for place in range(30)),
        links=[(place + 1, place) for place in range(29)] + [(29, 0)],
    ),
}


@pytest.mark.parametrize("name", [pytest.param(name) for name in GRAPHS])
def test_pictures_are_the_same_svg_each_time_with_nothing_cut_off(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    figures: list[Any] = []

    def write_svg(figure: Any, title: str) -> str:
        figures.append(figure)
        return paper.to_svg(figure, title)

    monkeypatch.setattr(picture, "to_svg", write_svg)
    drawn = draw_lineage(GRAPHS[name], "svg")
    assert ElementTree.fromstring(drawn).tag.endswith("svg")
    assert draw_lineage(GRAPHS[name], "svg") == drawn
    assert cut_off(figures[0]) == []


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name in ("cut off", "names with signs") else pytest.mark.soak) for name in GRAPHS],
)
def test_pictures_are_the_same_png_each_time(name: str) -> None:
    drawn = draw_lineage(GRAPHS[name], "png")
    assert imread(io.BytesIO(drawn)).shape[0] > 60
    assert draw_lineage(GRAPHS[name], "png") == drawn


def test_hundreds_of_clips_are_one_box_that_warns_of_the_outdated_one() -> None:
    texts = [
        text.text
        for text in ElementTree.fromstring(draw_lineage(GRAPHS["hundreds of clips"], "svg")).iter()
        if text.text
    ]
    assert {"300 clips in raw", "300 clips in target", "1 with a newer revision", "walk report@1"} <= set(texts)
    assert {"job_retarget", "seed 3", "retarget@3", "commit 5b130f77dd83"} <= set(texts)
    assert CUT_OFF not in texts
    assert CUT_OFF in draw_lineage(GRAPHS["cut off"], "svg").decode()


def test_graphviz_gets_every_box_and_arrow_with_texts_in_quotes() -> None:
    lines = draw_lineage(GRAPHS["names with signs"], "dot").decode().splitlines()
    assert (lines[0], lines[-1]) == ("digraph lineage {", "}")
    quoted = r'"(?:[^"\\]|\\.)*"'
    node, arrow = rf"  n\d+ \[label={quoted}, fillcolor={quoted}, color={quoted}(, shape=\w+)?\];", r"  n\d+ -> n\d+"
    assert all(re.fullmatch(rf"{node}|{arrow}( \[label={quoted}\])?;", line) for line in lines[3:-1])
    assert len([line for line in lines if "->" in line]) == 6
    assert WARNING in next(line for line in lines if "newest: 2" in line)


def test_graphs_too_large_for_a_picture_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(picture, "MOST_PIXELS", 1000)
    with pytest.raises(ValueError, match="write an SVG"):
        draw_lineage(GRAPHS["two clips"], "png")
    assert draw_lineage(GRAPHS["two clips"], "svg")
    monkeypatch.setattr(layers, "MOST_PASSED", 10)
    with pytest.raises(ValueError, match="too deep"):
        draw_lineage(GRAPHS["a chain"], "svg")


@given(
    arrows=st.lists(st.tuples(st.integers(0, 11), st.integers(0, 11)).filter(lambda one: one[0] < one[1]), max_size=30),
    order=st.permutations(range(12)),
)
def test_arrows_run_from_left_to_right_through_adjacent_layers(arrows: list[tuple[int, int]], order: list[int]) -> None:
    arrows = [(order[source], order[target]) for source, target in arrows]
    layout = lay_out(12, arrows)
    layer_of = {node: layer for layer, nodes in enumerate(layout.layers) for node in nodes}
    assert sum(map(len, layout.layers)) == len(layer_of)
    assert set(range(12)) <= layer_of.keys()
    for (source, target), route in zip(arrows, layout.routes, strict=True):
        assert (route[0], route[-1]) == (source, target)
        passed = [layer_of[node] for node in route]
        assert passed == list(range(layer_of[source], layer_of[target] + 1))
        assert len(passed) > 1
        assert all(node >= 12 for node in route[1:-1])


def test_a_cycle_of_arrows_is_refused() -> None:
    with pytest.raises(ValueError, match="cycle"):
        lay_out(3, [(0, 1), (1, 2), (2, 1)])


def test_neighbours_stand_beside_each_other() -> None:
    layout = lay_out(6, [(0, 5), (1, 4), (2, 3)])
    assert layout.layers[0] == [{5: 0, 4: 1, 3: 2}[box] for box in layout.layers[1]]


def test_aligned_clips_are_named_in_words() -> None:
    aligned = [revision(f"aligned/{place}", -1, kind=Kind.PROCESSED, job="job_align") for place in range(14)]
    graph = graph_of(revision("step", 0, kind=Kind.MODEL), *aligned, links=[(1 + place, 0) for place in range(14)])
    assert "14 aligned clips in aligned" in draw_lineage(graph, "svg").decode()

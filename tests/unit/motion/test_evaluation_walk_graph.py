import json
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from tests.support.evaluation_cases import clips_of, walked_record
from tests.support.present import present

from marey_motion.evaluation.relevance import count_switches, measure_usage
from marey_motion.evaluation.walk_graph import ClipGraph, clip_graph, graph_to_graphml, graph_to_tree, walk_graph

CLIPS = clips_of(10, 20, 5)
NAMESPACE = {"g": "http://graphml.graphdrawing.org/xmlns"}
WALK = [3, 4, 5, 15, 16, 17, 4, 5, 15]


def clip_graph_of(clips: tuple[Any, ...], *walks: Any) -> ClipGraph:
    records = [walked_record(rows) for rows in walks]
    used = [own.clip for own in measure_usage(clips, records) if own.ticks]
    return clip_graph(clips, count_switches(clips, records), used)


def test_nodes_are_the_displayed_frames_and_edges_the_jumps_between_them() -> None:
    graph = walk_graph(CLIPS, [walked_record(WALK)])

    assert graph.rows.tolist() == [3, 4, 5, 15, 16, 17]
    assert graph.ticks.tolist() == [1, 2, 2, 2, 1, 1]
    assert graph.edges.tolist() == [[5, 15, 2], [17, 4, 1]]


def test_the_walk_keeps_the_order_in_which_frames_were_displayed() -> None:
    (walk,) = walk_graph(CLIPS, [walked_record(WALK)]).walks

    assert walk.tolist() == [[0, 3, 3], [3, 15, 3], [6, 4, 2], [8, 15, 1]]
    shown = np.concatenate([np.arange(row, row + length) for _, row, length in walk])
    assert shown.tolist() == WALK


def test_a_run_ends_where_a_clip_ends() -> None:
    (walk,) = walk_graph(CLIPS, [walked_record([8, 9, 10, 11])]).walks

    assert walk.tolist() == [[0, 8, 2], [2, 10, 2]]


def test_the_tree_names_clips_and_frames_and_goes_through_json() -> None:
    tree = json.loads(json.dumps(graph_to_tree(walk_graph(CLIPS, [walked_record(WALK)]))))

    assert tree["clips"][1] == {"uid": "b", "name": "clip 1", "frames": 20}
    assert tree["nodes"]["clip"] == [0, 0, 0, 1, 1, 1]
    assert tree["nodes"]["frame"] == [3, 4, 5, 5, 6, 7]
    assert tree["edges"] == {"source": [2, 5], "target": [3, 1], "count": [2, 1]}
    assert tree["walks"][0] == {
        "tick": [0, 3, 6, 8],
        "clip": [0, 1, 0, 1],
        "frame": [3, 5, 4, 5],
        "frames": [3, 3, 2, 1],
    }


def test_graphml_holds_the_same_graph() -> None:
    root = ElementTree.fromstring(graph_to_graphml(walk_graph(CLIPS, [walked_record(WALK), walked_record([30, 31])])))
    graph = root.find("g:graph", NAMESPACE)
    nodes = {node.get("id"): node for node in present(graph).findall("g:node", NAMESPACE)}
    edges = present(graph).findall("g:edge", NAMESPACE)
    declared = {key.get("id") for key in root.findall("g:key", NAMESPACE)}

    assert present(graph).get("edgedefault") == "directed"
    assert len(nodes) == 8
    values = {data.get("key"): data.text for data in nodes["n15"].findall("g:data", NAMESPACE)}
    assert values == {"clip": "b", "name": "clip 1", "frame": "5", "ticks": "2"}
    found = [(edge.get("source"), edge.get("target"), present(edge.find("g:data", NAMESPACE)).text) for edge in edges]
    assert found == [("n5", "n15", "2"), ("n17", "n4", "1")]
    walks = {data.get("key"): data.text for data in present(graph).findall("g:data", NAMESPACE)}
    assert walks == {"walk0": "n3:3 n15:3 n4:2 n15:1", "walk1": "n30:2"}
    assert declared == {data.get("key") for data in root.iter(f"{{{NAMESPACE['g']}}}data")}


@pytest.mark.parametrize("name", ['a<b>&"c"', "tab\tand\x00\x0bcontrols", "\ud800 lonely", "走る 🏃"])
def test_graphml_can_be_read_whatever_clips_are_called(name: str) -> None:
    clips = (replace(CLIPS[0], name=name), *CLIPS[1:])
    root = ElementTree.fromstring(graph_to_graphml(walk_graph(clips, [walked_record([1, 2])])))
    names = [data.text for data in root.iter(f"{{{NAMESPACE['g']}}}data") if data.get("key") == "name"]

    readable = name.translate(dict.fromkeys([0x00, 0x0B, 0xD800], "\ufffd"))
    assert names == [readable, readable]


def test_clips_that_lead_to_each_other_are_one_component() -> None:
    graph = clip_graph_of(clips_of(10, 10, 10, 10), [1, 11, 2, 21, 3, 12, 13, 4])

    assert graph.components == ((0, 1, 2),)
    assert graph.dead_ends == ()
    assert graph.counts == {(0, 1): 2, (0, 2): 1, (1, 0): 2, (2, 0): 1}


def test_clips_that_are_entered_and_not_left_again_are_a_dead_end() -> None:
    graph = clip_graph_of(clips_of(10, 10, 10, 10), [1, 11, 2, 21, 31, 22], [3, 12])

    assert graph.components == ((0, 1), (2, 3))
    assert graph.dead_ends == ((2, 3),)


def test_a_clip_that_is_all_a_walk_needs_is_no_dead_end() -> None:
    graph = clip_graph_of(CLIPS, [1, 2, 7, 8, 3])

    assert graph.components == ((0,),)
    assert graph.dead_ends == ()
    assert graph.counts == {(0, 0): 2}


def test_components_agree_with_reachability_by_brute_force() -> None:
    generator = np.random.default_rng(5)
    for _ in range(50):
        count = int(generator.integers(2, 9))
        clips = clips_of(*[1000] * count)
        # A walk may break off and begin elsewhere: several short trials.
        walks = [1000 * generator.integers(0, count, 3) + generator.integers(0, 900, 3) for _ in range(count)]
        graph = clip_graph_of(clips, *walks)
        reaches = np.eye(count, dtype=bool)
        for left, entered in graph.counts:
            reaches[left, entered] = True
        for middle in range(count):
            reaches |= reaches[:, [middle]] & reaches[[middle], :]
        mutual = reaches & reaches.T
        used = sorted({int(row) // 1000 for walk in walks for row in walk})
        expected = {tuple(np.flatnonzero(mutual[clip]).tolist()) for clip in used}

        assert set(graph.components) == expected
        sizes = [len(component) for component in graph.components]
        assert sizes == sorted(sizes, reverse=True)
        for component in graph.components:
            inside = list(component)
            outside = [clip for clip in used if clip not in component]
            leads_out = reaches[np.ix_(inside, outside)].any()
            led_into = reaches[np.ix_(outside, inside)].any()
            assert (component in graph.dead_ends) == (led_into and not leads_out)

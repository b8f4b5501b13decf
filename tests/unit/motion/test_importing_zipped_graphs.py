"""Import of the predecessor's zipped graphs: what they become, and what is refused."""

from __future__ import annotations

import io
import json
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from tests.support import predecessor_documents as old
from tests.support import predecessor_models as models
from tests.support.predecessor_records import zipped, zipped_graph

from marey_motion.formats import detect_format
from marey_motion.formats.predecessor import zipped_graph as reader
from marey_motion.importing.files import import_file
from marey_motion.importing.items import FileToImport, ImportedFile
from marey_motion.importing.plan import plan_imports
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions

DIGEST = f"sha256:{'1' * 64}"
NAME = "in/grasp.mg.zip"


def imported(data: bytes) -> ImportedFile:
    return import_file(FileToImport(plan_imports([NAME])[0], data, DIGEST, ImportOptions(collection="old")))


def refusal(data: bytes) -> tuple[str, str]:
    refused = imported(data).refusal
    assert refused is not None
    return refused.code, refused.detail


def changed(**members: Any) -> bytes:
    """Return the zipped graph with members replaced, or removed for None; underscores in names stand for dots."""
    names = {"definition": "graph_definition.json", "skeleton": "skeleton.json",
             "begin": "elementary_action_models/elementary_action_walk/walk_begin_quaternion_mm.json",
             "meta": "elementary_action_models/elementary_action_walk/meta_information.json"}  # fmt: skip
    with zipfile.ZipFile(io.BytesIO(zipped_graph())) as archive:
        found: dict[str, Any] = {one: archive.read(one) for one in archive.namelist()}
    found |= {names[name]: member for name, member in members.items()}
    return zipped({name: member for name, member in found.items() if member is not None})


def test_a_zipped_graph_becomes_a_skeleton_models_with_trees_and_a_graph_in_a_folder() -> None:
    found = imported(zipped_graph())
    assert found.refusal is None, found.refusal
    assert [(one.kind, one.collection, one.item_name) for one in found.items] == [
        (Kind.SKELETON, "skeletons", "hik (171 cm)"),
        (Kind.MODEL, "old/in/grasp", "walk_begin"),
        (Kind.MODEL, "old/in/grasp", "walk_left"),
        (Kind.MODEL, "old/in/grasp", "idle_stand"),
    ]
    skeleton, begin, left, stand = found.items
    mapping = skeleton.parts["mapping"]
    assert mapping["axes"]["LeftArm"]["swing"] == [0.0, 0.0, 1.0]
    assert mapping["predecessor"]["rest"]["foot_joints"] == ["LeftFoot", "RightFoot"]
    assert "skeleton" not in mapping["predecessor"], "the archive is not the file of the skeleton"
    assert set(begin.parts) == {"model", "tree"}
    assert set(left.parts) == set(stand.parts) == {"model"}
    assert {one.parts["model"]["skeleton"]["output"] for one in (begin, left, stand)} == {skeleton.name}
    assert begin.parts["model"]["provenance"]["predecessor"].get("original") is None
    joints = old.joints_of(old.RIG)
    scores = np.random.default_rng(1).normal(size=models.SPATIAL)
    for item, document in ((begin, models.layout_3(11, joints)), (left, models.layout_2(12, joints))):
        space = item.parts["model"]["spatial"]
        ours = np.asarray(space["mean"]) + np.tensordot(scores, space["directions"], axes=1)
        theirs = old.model_poses(document, scores)
        np.testing.assert_allclose(ours[0, :3] * 100, theirs[0, :3] + old.RIG[0].offset, atol=1e-9)
        np.testing.assert_allclose(ours[-1, 3:], theirs[-1, 3:], atol=1e-12)


def test_keyframes_of_an_action_are_frames_ends_or_the_middle() -> None:
    _, begin, left, _ = imported(zipped_graph()).items
    assert begin.parts["model"]["keyframes"] == {"contact": 30, "last": 47, "contact0": 20}
    assert left.parts["model"]["keyframes"] == {"end": 47, "half": 24}
    _, detail = refusal(changed(meta={"annotations": {"begin": {"contact": "soon"}}}))
    assert "keyframe 'contact' must be" in detail


@pytest.mark.parametrize("colon", [False, True])
def test_transitions_types_and_start_of_both_forms(colon: bool) -> None:
    graph = imported(zipped_graph(colon=colon)).graph
    assert graph is not None
    assert (graph.name, graph.collection) == ("grasp", "old/in/grasp")
    assert graph.graph.start == ("idle", "idle_stand")
    assert {place: (node.type, node.transitions) for place, node in graph.graph.nodes.items()} == {
        ("idle", "idle_stand"): ("idle", (("idle", "idle_stand"), ("walk", "walk_begin"))),
        ("walk", "walk_begin"): ("start", (("walk", "walk_left"),)),
        ("walk", "walk_left"): ("end", (("idle", "idle_stand"),)),
    }


def test_a_graph_without_a_start_begins_with_the_idle_node_of_walk_or_is_refused() -> None:
    transitions = {"idle_stand": ["idle_stand"], "walk_begin": ["walk_left"]}
    meta = {"idle_states": ["left"], "start_states": ["begin"], "end_states": []}
    found = imported(changed(definition={"transitions": transitions}, meta=meta)).graph
    assert found is not None
    assert found.graph.start == ("walk", "walk_left")
    assert "'startNode' must be a list of two names" in refusal(changed(definition={"transitions": transitions}))[1]
    lost = {"transitions": transitions, "startNode": ["walk", "stand"]}
    assert "['walk', 'stand'], which does not exist" in refusal(changed(definition=lost))[1]


def test_pickled_trees_are_not_read_and_strange_transitions_left_out_with_warnings() -> None:
    found = imported(zipped_graph(tree="pickle"))
    assert found.refusal is None
    assert set(found.items[1].parts) == {"model"}
    (check,) = found.checks
    assert check["code"] == "tree-pickled"
    assert "walk_begin_quaternion_cluster_tree.pck" in check["message"]
    transitions = {"idle_stand": ["idle_stand", "walk_begin", "jump_high"], "walk_begin": ["walk_left"]}
    definition = {"transitions": transitions, "startNode": ["idle", "stand"]}
    assert [(one["code"], "idle_stand to jump_high" in one["message"]) for one in imported(
        changed(definition=definition)
    ).checks] == [("transitions-ignored", True)]  # fmt: skip


@pytest.mark.parametrize("name", ["jump\ud800high", "x" * 2_000_000], ids=["half of a pair", "long"])
def test_names_in_warnings_can_be_stored_and_are_short(name: str) -> None:
    transitions = {name: [f"{name}{end}" for end in range(2)], "walk_begin": ["walk_left"]}
    (check,) = imported(changed(definition={"transitions": transitions, "startNode": ["idle", "stand"]})).checks
    assert check["code"] == "transitions-ignored"
    assert len(check["message"].encode()) < 1000


def test_names_in_refusals_are_short() -> None:
    for wrong in ({"transitions": {"x" * 100_000: 1}}, {"transitions": {}, "startNode": ["walk", "x" * 100_000]}):
        assert len(refusal(changed(definition=wrong))[1]) < 1000
    labels = {"annotations": {"begin": {"x" * 100_000: "y" * 100_000}}}
    assert len(refusal(changed(meta=labels))[1]) < 1000


def test_types_and_trees_are_found_without_searching_all_members_for_each_model(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The time of these searches grew with the square of the number of models, up to minutes for permitted graphs."""
    searched: Counter[str] = Counter()
    unpacked, list_of = reader._members, reader._list_of

    class Members(dict[str, bytes]):
        def __iter__(self) -> Iterator[str]:
            searched["members"] += 1
            return super().__iter__()

    def counted(document: Any, name: str, file: str) -> list[Any]:
        searched[name] += 1
        return list_of(document, name, file)

    monkeypatch.setattr(reader, "_members", lambda data, file: Members(unpacked(data, file)))
    monkeypatch.setattr(reader, "_list_of", counted)
    count, folder = 50, "elementary_action_models/elementary_action_walk"
    members: dict[str, Any] = {
        "skeleton.json": {},
        "graph_definition.json": {"transitions": {}, "startNode": ["walk", "m0"]},
        f"{folder}/meta_information.json": {"cycle_states": [f"m{number}" for number in range(count)]},
    }
    for number in range(count):
        members[f"{folder}/walk_m{number}_quaternion_mm.json"] = {}
        members[f"{folder}/walk_m{number}_cluster_tree.json"] = {"of": number}
        members[f"{folder}/walk_m{number}_cluster_tree.pck"] = b""
    read = reader.read_zipped_graph(zipped(members), NAME)
    assert [json.loads(one.tree or b"") for one in read.models] == [{"of": number} for number in range(count)]
    assert {node.type for node in read.graph.nodes.values()} == {"cycle_end"}
    assert len(read.pickled) == count
    assert searched["members"] < 10
    assert searched["cycle_states"] == 1


def test_a_skeleton_in_bvh_has_the_unit_and_the_axes_of_the_predecessor() -> None:
    found = imported(zipped_graph(skeleton="bvh"))
    assert found.refusal is None, found.refusal
    offsets = [joint["offset"] for joint in found.items[0].parts["hierarchy"]["joints"]]
    np.testing.assert_allclose(offsets[0], np.array(old.RIG[0].offset) / 100.0)


def test_what_is_no_graph_or_does_not_fit_is_refused_with_the_member() -> None:
    assert refusal(zipped({"notes.json": {}})) == (
        "not-a-graph",
        f"{NAME}: the archive is no graph of the predecessor, because it has no member 'graph_definition.json'",
    )
    assert "damaged" in refusal(zipped_graph()[:3000])[1]
    assert "no member 'skeleton.json' or 'skeleton.bvh'" in refusal(changed(skeleton=None))[1]
    assert "walk_begin_quaternion_mm.json" in refusal(changed(begin={"sspm": {}, "tspm": {}, "gmm": {}}))[1]
    twice = "elementary_action_models/elementary_action_walk_begin/walk_begin_walk_mm.json"
    first = "elementary_action_models/elementary_action_walk/walk_begin_walk_mm.json"
    both = zipped({"graph_definition.json": {}, "skeleton.json": old.file_skeleton(), first: {}, twice: {}})
    assert "two models are called 'walk_begin_walk'" in refusal(both)[1]
    other = [old.Node("Hips", None, (0.0, 0.0, 0.0)), *old.RIG[1:5], *old.RIG[5:]]
    other[1] = old.Node("Spine", "Hips", (0.0, 30.0, 0.0))
    code, detail = refusal(changed(skeleton=old.file_skeleton(tuple(other))))
    assert code == "skeleton-mismatch"
    assert "unpack the archive" in detail


def test_archives_that_unpack_to_too_much_are_refused_before_they_are_unpacked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reader, "MOST_UNPACKED_BYTES", 1 << 20)
    bomb = zipped({"graph_definition.json": b" " * (1 << 20) + b"{}"})
    assert len(bomb) < 4096
    code, detail = refusal(bomb)
    assert code == "format-limit"
    assert "at most 1,048,576 bytes" in detail
    lying = bomb.replace(((1 << 20) + 2).to_bytes(4, "little"), (64).to_bytes(4, "little"))
    assert refusal(lying)[0] == "not-a-graph", "a member that declares less than it holds is damaged"


@pytest.mark.parametrize("name", ["", "\0notes.json"])
def test_members_without_a_name_are_refused(name: str) -> None:
    archive = io.BytesIO(zipped_graph())
    with zipfile.ZipFile(archive, "a") as written:
        member = zipfile.ZipInfo("x" * len(name))
        member.filename = name  # the constructor would end it at NUL
        written.writestr(member, b"{}")
    assert refusal(archive.getvalue()) == ("not-a-graph", f"{NAME}: a member of the archive has no name")


SMALL = zipped({"graph_definition.json": {"transitions": {}}, "skeleton.json": {}, "notes/": b""})
FIRST_NAME = SMALL.index(b"PK\x01\x02") + 46


@given(st.lists(st.tuples(st.integers(0, len(SMALL) - 1), st.integers(0, 255)), min_size=1, max_size=4))
@example([(FIRST_NAME, 0)])
@example([(FIRST_NAME - 18, 0), (FIRST_NAME - 16, 21)])
def test_damaged_archives_are_refused(flips: Iterable[tuple[int, int]]) -> None:
    data = bytearray(SMALL)
    for place, byte in flips:
        data[place] = byte
    assert import_file(FileToImport(plan_imports([NAME])[0], bytes(data), DIGEST)).refusal is not None


def test_other_archives_are_still_to_be_unpacked() -> None:
    assert detect_format(zipped_graph(), NAME).name == "predecessor"
    with pytest.raises(Exception, match="unpack it"):
        detect_format(zipped_graph(), "grasp.zip")

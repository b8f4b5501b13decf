"""Copies of versions to another project.

Their documents may refer to content of other entries, or of later versions.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.rest_server import Server
from tests.support.store_fixtures import motion_tree, skeleton_tree
from tests.support.tiers import examples

from marey_client import Marey
from marey_client.archives import documents
from marey_client.blobs import Blobs
from marey_client.errors import RequestFailed
from marey_client.handles.versions import DatasetHandle
from marey_client.items import ItemHandle
from marey_client.project import ProjectHandle
from marey_client.transport import Transport
from marey_schemas.access import ProjectCreate, Role
from marey_schemas.datasets.commits import Commit, MoveEntry, PutEntry, RemoveEntry
from marey_schemas.encoding.array_differences import ArrayDifference
from marey_schemas.encoding.canonical import array_digest
from marey_schemas.kinds import Kind
from marey_server.access.principal import SYSTEM
from marey_server.http import negotiation
from marey_server.store import projects
from marey_server.store.datasets import partial_contents
from marey_server.store.items.facets import publish_facets
from marey_server.store.transaction import Transaction
from marey_versions.archive.checking import check_archive
from marey_versions.archive.members import MemberKind
from marey_versions.archive.reading import Archive


@pytest.fixture
def marey(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Marey]:
    """The client of the owner of `lab` and of the empty project `partner`."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with Marey(server.address, server.make_project()) as client:
        client.create_project(ProjectCreate(name="partner"))
        yield client


@pytest.fixture
def lab(marey: Marey) -> ProjectHandle:
    return marey.project("lab")


@pytest.fixture
def partner(marey: Marey) -> ProjectHandle:
    return marey.project("partner")


@pytest.fixture
def gaits(lab: ProjectHandle) -> DatasetHandle:
    return lab.datasets.create("gaits")


def make_rig(lab: ProjectHandle, joints: int = 2, name: str = "rig") -> ItemHandle:
    return lab.skeletons.create(name, {"hierarchy": skeleton_tree(joints)})


def make_clip(lab: ProjectHandle, rig: ItemHandle) -> ItemHandle:
    info = {"schema": "marey/clip-info@1", "comment": "first"}
    return lab.clips.create("walk", {"motion": motion_tree(rig.item, joints=2), "info": info})


def label(lab: ProjectHandle, clip: ItemHandle) -> ItemHandle:
    layer = {"schema": "marey/annotation@1", "clip": {"item": clip.id, "revision": clip.item.revision}}
    return lab.annotations.create("labels", {"annotation": layer})


def commit(gaits: DatasetHandle, **items: ItemHandle) -> Commit:
    return gaits.commit("m", changes=[PutEntry(path=path, item=one.id) for path, one in items.items()])


def assert_copied(partner: ProjectHandle, gaits: DatasetHandle, made: Commit) -> None:
    """Copy the branch `main`, and check that the other project has the version with the content of each entry."""
    moved = partner.datasets.pull(gaits, "gaits")
    assert moved.moved
    assert moved.commit == made
    found = {one.path: (one.parts, one.item is None) for one in partner.datasets.at("gaits").entries()}
    assert found == {one.path: (one.parts, False) for one in gaits.entries()}


def test_a_skeleton_its_clip_and_the_labels_of_the_clip_may_be_entries_of_one_version(
    lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle
) -> None:
    rig = make_rig(lab)
    clip = make_clip(lab, rig)
    assert_copied(partner, gaits, commit(gaits, labels=label(lab, clip), rig=rig, walk=clip))


def test_a_clip_may_refer_to_a_skeleton_that_a_later_version_adds(
    lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle
) -> None:
    rig = make_rig(lab)
    commit(gaits, walk=make_clip(lab, rig))
    assert_copied(partner, gaits, commit(gaits, rig=rig))


@pytest.mark.parametrize("earlier_copy", [True, False])
def test_labels_may_refer_to_a_revision_of_a_clip_that_a_later_version_adds(
    lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle, earlier_copy: bool
) -> None:
    clip = make_clip(lab, make_rig(lab))
    first = commit(gaits, walk=clip)
    if earlier_copy:
        assert_copied(partner, gaits, first)
    clip.put_part("info", {"schema": "marey/clip-info@1", "comment": "second"})
    commit(gaits, labels=label(lab, clip))
    assert_copied(partner, gaits, commit(gaits, walk=clip))


def test_a_checkout_creates_labels_of_a_deleted_clip(lab: ProjectHandle) -> None:
    """The clip is not an entry of the version, but the content of the clip is kept."""
    gaits = lab.datasets.create("gaits", collection="gaits")
    clip = make_clip(lab, make_rig(lab))
    labels = label(lab, clip)
    first = commit(gaits, labels=labels)
    clip.delete()
    gaits.check_out(first.digest)
    (made,) = lab.annotations.list(collection="gaits")
    assert made.id != labels.id
    assert made.part("annotation")["clip"] == {"item": clip.id, "revision": 1}
    gaits.commit("none", changes=[RemoveEntry(path="labels", kind=Kind.ANNOTATION)])
    assert gaits.check_out().removed == 1


def test_a_server_of_an_earlier_version_gets_plain_bodies(
    lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[bool] = []
    is_compressed = negotiation.is_compressed

    def noted(content_encoding: str | None, *, may_be: bool) -> bool:
        if may_be:
            sent.append(content_encoding is not None)
        return is_compressed(content_encoding, may_be=False)

    monkeypatch.setattr(negotiation, "is_compressed", noted)
    assert_copied(partner, gaits, commit(gaits, rig=make_rig(lab, joints=200)))
    assert sent.count(True) == 1
    assert False in sent[sent.index(True) :]


def measure(server: Server, item: ItemHandle, project: str = "lab", **values: float) -> None:
    """Publish facets of the newest revision of an item, as a job does."""
    stated = [[item.id, item.item.revision, values]]

    def publish(tx: Transaction) -> None:
        publish_facets(tx, projects.require(tx, project).id, stated)

    server.database.write(SYSTEM, publish)


def facets_of(project: ProjectHandle) -> dict[str, dict[str, float]]:
    return {one.item.name: dict(one.item.facets) for one in project.clips.list(collection="gaits")}


def test_facets_come_with_a_copy_and_with_an_archive(
    server: Server, marey: Marey, lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle, tmp_path: Path
) -> None:
    """Queries select the same clips on the source, after a copy, and after the import of an archive."""
    clip = make_clip(lab, make_rig(lab))
    measure(server, clip, usage=0.5, used_frames=1.0)
    commit(gaits, walk=clip)
    marey.create_project(ProjectCreate(name="third"))
    third = marey.project("third")
    gaits.archive(tmp_path / "gaits.tar")
    third.datasets.import_archive(tmp_path / "gaits.tar", "gaits")
    partner.datasets.pull(gaits, "gaits")
    for copy in (partner, third):
        copy.datasets.at("gaits").check_out()
        assert facets_of(copy) == {"walk": {"usage": 0.5, "used_frames": 1.0}}
        assert [one.item.name for one in copy.clips.list(query="facet.usage = 0.5")] == ["walk"]


def test_no_member_of_an_archive_has_the_facets_of_all_revisions(
    server: Server, lab: ProjectHandle, gaits: DatasetHandle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Members of more than 256 MiB are refused, and a version may have a million clips."""
    clip = make_clip(lab, make_rig(lab))
    measure(server, clip, usage=0.5)
    commit(gaits, walk=clip)
    clip.put_part("info", {"schema": "marey/clip-info@1", "comment": "second"})
    measure(server, clip, usage=0.75)
    commit(gaits, walk=clip)
    monkeypatch.setattr(documents, "MOST_CONTENTS", 1)
    gaits.archive(tmp_path / "gaits.tar")
    with (tmp_path / "gaits.tar").open("rb") as file:
        archive = Archive(file)
        assert sum(member.kind is MemberKind.FACETS for member in archive.members) == 2
        assert sorted(archive.facets().values(), key=str) == [{"usage": 0.5}, {"usage": 0.75}]


def test_a_copy_adds_facets_to_content_that_the_project_has_and_replaces_none(
    server: Server, lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle
) -> None:
    walk = make_clip(lab, make_rig(lab))
    commit(gaits, walk=walk)
    partner.datasets.pull(gaits, "gaits")
    partner.datasets.at("gaits").check_out()
    (there,) = partner.clips.list(collection="gaits")
    measure(server, there, "partner", usage=0.25)
    measure(server, walk, usage=0.5, used_frames=1.0)
    gaits.commit("Move", changes=[MoveEntry(path="walk", kind=Kind.CLIP, to="stroll")])
    partner.datasets.pull(gaits, "gaits")
    assert facets_of(partner) == {"walk": {"usage": 0.25, "used_frames": 1.0}}


def test_a_checkout_of_known_content_keeps_its_facets(server: Server, lab: ProjectHandle) -> None:
    gaits = lab.datasets.create("gaits", collection="gaits")
    rig = make_rig(lab)
    clip = lab.clips.create("walk", {"motion": motion_tree(rig.item, joints=2)}, collection="gaits")
    measure(server, clip, usage=0.5)
    first = gaits.commit("measured")
    clip.put_part("info", {"schema": "marey/clip-info@1", "comment": "changed"})
    gaits.commit("changed")
    assert facets_of(lab) == {"walk": {}}
    gaits.check_out(first.digest)
    assert facets_of(lab) == {"walk": {"usage": 0.5}}
    assert next(lab.clips.list(collection="gaits")).item.revision == 3


def test_a_file_that_a_version_needs_is_copied_although_its_clip_is_deleted(
    server: Server, lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle
) -> None:
    """Another user has uploaded the file, and only a deleted clip refers to it."""
    with Marey(server.address, server.make_user("ben")) as ben:
        lab.members.put("ben", Role.CONTRIBUTOR)
        file = ben.blobs.put(b"HIERARCHY")
        info = {"schema": "marey/clip-info@1", "source": {"file": file, "file_name": "walk.bvh"}}
        motion = motion_tree(make_rig(lab).item, joints=2)
        clip = ben.project("lab").clips.create("walk", {"motion": motion, "info": info}).id
    lab.clips.get(clip).delete()
    owner = Blobs(lab.transport)
    assert owner.missing(file) == {file}
    commit(gaits, walk=lab.clips.restore(clip))
    lab.clips.get(clip).delete()
    assert owner.fetch(file) == b"HIERARCHY"
    assert partner.datasets.pull(gaits, "gaits").moved


def test_a_reference_to_an_item_of_the_receiving_project_is_refused_with_what_to_do(
    marey: Marey, lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle
) -> None:
    """Only the receiving project has the item, so the digest of the same document differs there."""
    rig = make_rig(partner)
    body = {"schema": "marey/document@1", "rig": {"item": rig.id, "revision": 1}}
    study = lab.items(Kind.CHARACTER).create("character", {"character": body})
    commit(gaits, character=study)
    with pytest.raises(
        RequestFailed, match=f"character 'character' refers to the item {rig.id} of this project"
    ) as caught:
        partner.datasets.pull(gaits, "gaits")
    assert (caught.value.code, "another project" in str(caught.value)) == ("other-content", True)
    marey.create_project(ProjectCreate(name="third"))
    assert marey.project("third").datasets.pull(gaits, "gaits").moved


@pytest.mark.parametrize("copied_before", [True, False])
def test_only_the_changed_blocks_of_a_clip_are_sent(
    lab: ProjectHandle,
    partner: ProjectHandle,
    gaits: DatasetHandle,
    monkeypatch: pytest.MonkeyPatch,
    copied_before: bool,
) -> None:
    """The receiver has the clip from an earlier copy, or gets its earlier version in the same copy."""
    motion = motion_tree(make_rig(lab, 20).item, joints=20, frames=12 * 256)
    clip = lab.clips.create("walk", {"motion": motion, "info": {"schema": "marey/clip-info@1", "comment": "c"}})
    first = commit(gaits, walk=clip)
    if copied_before:
        assert_copied(partner, gaits, first)
    motion["poses"][600:610, 0] += 0.5
    clip.put_part("motion", motion)
    second = commit(gaits, walk=clip)
    sent: list[int] = []
    send = Transport.send

    def noted(self: Transport, method: str, path: str, *, content: Any = None, **options: Any) -> Any:
        if path.endswith("/datasets/gaits/contents"):
            sent.append(len(content))
        return send(self, method, path, content=content, **options)

    monkeypatch.setattr(Transport, "send", noted)
    assert_copied(partner, gaits, second)
    size = motion["poses"].nbytes
    assert sent[-1] < size / 10
    assert len([one for one in sent if one > size / 2]) == (0 if copied_before else 1)
    made = partner.datasets.at("gaits").check_out("main")
    assert made is not None
    (copy,) = partner.clips.list(collection="gaits")
    assert (copy.part("motion")["poses"] == motion["poses"]).all()


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """The requests that the client sends: path, and size with headers of request and answer together, in bytes."""
    noted: list[tuple[str, int]] = []
    once = Transport.send

    def send(self: Transport, method: str, path: str, **options: Any) -> httpx.Response:
        response = once(self, method, path, **options)
        heads = [*response.request.headers.raw, *response.headers.raw]
        size = sum(len(name) + len(value) + 4 for name, value in heads)
        noted.append((path, size + len(response.request.content) + len(response.content)))
        return response

    monkeypatch.setattr(Transport, "send", send)
    return noted


def make_walk(lab: ProjectHandle, name: str = "walk", frames: int = 900) -> ItemHandle:
    """Create a clip with the poses of random smooth motion."""
    motion = motion_tree(make_rig(lab, 20, f"rig of {name}").item, joints=20, frames=frames)
    rng = np.random.default_rng(len(name))
    motion["poses"][:, :3] = np.cumsum(rng.normal(size=(frames, 3)), axis=0) / 100
    info = {"schema": "marey/clip-info@1", "comment": "first"}
    return lab.clips.create(name, {"motion": motion, "info": info})


def edit(clip: ItemHandle, frames: slice, by: float) -> None:
    motion = clip.part("motion")
    motion["poses"][frames, :3] += np.float32(by)
    clip.put_part("motion", motion)


def poses_in(partner: ProjectHandle, name: str = "walk") -> Any:
    """Return the poses of a clip of the copied version, after a checkout."""
    partner.datasets.at("gaits").check_out("main", discard=True)
    (found,) = (one for one in partner.clips.list(collection="gaits") if one.name == name)
    return found.part("motion")["poses"]


def test_a_few_edited_frames_of_a_short_clip_are_sent_alone_on_both_ways(
    lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle, sent: list[tuple[str, int]]
) -> None:
    """All frames of the clip are in one block, so that a partial array would be the whole array."""
    clip = make_walk(lab)
    assert_copied(partner, gaits, commit(gaits, walk=clip))
    first = sum(size for path, size in sent if path.endswith("/contents"))
    edit(clip, slice(500, 509), 0.25)
    made = commit(gaits, walk=clip)
    sent.clear()
    assert_copied(partner, gaits, made)
    assert sum(size for path, size in sent if path.endswith("/contents")) < first / 4
    assert max(size for path, size in sent if path.endswith("/gaits/contents")) < 4_000
    assert (poses_in(partner) == clip.part("motion")["poses"]).all()


@pytest.mark.parametrize("seed", range(examples(2, soak=4)))
def test_random_edits_of_random_clips_arrive_equal_whatever_the_receiver_holds(
    lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle, seed: int
) -> None:
    """Edits, insertions, and returns to earlier content, in one or several versions between two copies."""
    random = Random(seed)
    clips = {name: make_walk(lab, name, random.choice([3, 300, 900])) for name in ("a", "walk", "third")}
    made = commit(gaits, **clips)
    for step in range(8):
        if random.random() < 0.5:
            assert_copied(partner, gaits, made)
        for name in random.sample(sorted(clips), random.randint(1, 3)):
            clip, motion = clips[name], clips[name].part("motion")
            poses = motion["poses"]
            start = random.randrange(len(poses))
            first = clip.part("motion", revision=1)
            what = random.choice(["edit", "insert", "info", "first"])
            if what == "insert":
                motion["poses"] = np.concatenate([poses[:start], poses[: random.randint(1, 5)], poses[start:]])
            elif what == "first" and array_digest(first["poses"]) != array_digest(poses):  # else nothing to commit
                motion = first
            else:
                poses[start : start + random.randint(1, 40), : random.randint(1, 3)] += np.float32(random.random())
            clip.put_part("motion", motion)
            if what == "info":
                clip.put_part("info", {"schema": "marey/clip-info@1", "comment": f"{step}"})
        made = commit(gaits, **clips)
    assert_copied(partner, gaits, made)
    for name, clip in clips.items():
        assert array_digest(poses_in(partner, name)) == array_digest(clip.part("motion")["poses"])


def test_a_copy_from_a_server_of_an_earlier_version_reads_whole_arrays(
    lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip = make_walk(lab)
    assert_copied(partner, gaits, commit(gaits, walk=clip))
    edit(clip, slice(500, 509), 0.25)
    made = commit(gaits, walk=clip)
    once = Transport.send
    refusals: list[bytes] = []

    def send(self: Transport, method: str, path: str, *, content: Any = None, **options: Any) -> httpx.Response:
        if path.endswith("/lab/contents") and b'"base"' in content:
            refusals.append(content)
            content = content.replace(b'"base"', b'"unknown"')
        return once(self, method, path, content=content, **options)

    monkeypatch.setattr(Transport, "send", send)
    assert_copied(partner, gaits, made)
    assert len(refusals) == 1
    assert (poses_in(partner) == clip.part("motion")["poses"]).all()


def test_a_copy_to_a_server_of_an_earlier_version_sends_whole_arrays(
    lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A server of an earlier version takes an array difference for a malformed array."""
    between = ArrayDifference.between
    clip = make_walk(lab)
    assert_copied(partner, gaits, commit(gaits, walk=clip))
    edit(clip, slice(500, 509), 0.25)
    made = commit(gaits, walk=clip)
    monkeypatch.setattr(partial_contents, "ArrayDifference", SimpleNamespace(of=lambda _: None, between=between))
    assert_copied(partner, gaits, made)
    assert (poses_in(partner) == clip.part("motion")["poses"]).all()
    assert list((tmp_path / "cache").rglob("*.tar*")) == []


def test_a_copy_with_differences_continues_after_an_interruption(
    lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The copy is interrupted by Ctrl-C while it reads documents, and again while it sends them."""
    clips = {name: make_walk(lab, name) for name in ("a", "walk")}
    assert_copied(partner, gaits, commit(gaits, **clips))
    for clip in clips.values():
        edit(clip, slice(500, 509), 0.25)
    made = commit(gaits, **clips)
    once = Transport.send
    for ending in ("/lab/contents", "/gaits/received-commits"):

        def send(self: Transport, method: str, path: str, *, ending: str = ending, **options: Any) -> httpx.Response:
            if path.endswith(ending):
                raise KeyboardInterrupt
            return once(self, method, path, **options)

        with monkeypatch.context() as interrupted:
            interrupted.setattr(Transport, "send", send)
            with pytest.raises(KeyboardInterrupt):
                partner.datasets.pull(gaits, "gaits")
    (kept,) = (tmp_path / "cache").rglob("*.tar")
    with kept.open("rb") as file:
        archive = Archive(file)
        check_archive(archive)
        assert sum(member.kind is MemberKind.DIFFERENCES for member in archive.members) == 2
        assert not any(member.kind is MemberKind.ARRAY for member in archive.members)
    assert_copied(partner, gaits, made)
    assert (poses_in(partner) == clips["walk"].part("motion")["poses"]).all()
    assert list((tmp_path / "cache").rglob("*.tar*")) == []


def test_an_archive_of_later_versions_contains_whole_arrays(
    lab: ProjectHandle, gaits: DatasetHandle, tmp_path: Path
) -> None:
    clip = make_walk(lab)
    first = commit(gaits, walk=clip)
    edit(clip, slice(500, 509), 0.25)
    commit(gaits, walk=clip)
    gaits.archive(tmp_path / "later.tar", since=first.digest)
    with (tmp_path / "later.tar").open("rb") as file:
        archive = Archive(file)
        kinds = {member.kind for member in archive.members}
        assert (MemberKind.ARRAY in kinds, MemberKind.DIFFERENCES in kinds) == (True, False)


def test_tiles_that_do_not_fit_into_one_answer_are_asked_for_again(
    lab: ProjectHandle,
    partner: ProjectHandle,
    gaits: DatasetHandle,
    sent: list[tuple[str, int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two versions of long clips are copied at once: the receiver has the first when it gets the second."""
    clips = {name: make_walk(lab, name, 12 * 256) for name in ("a", "walk", "third")}
    commit(gaits, **clips)
    for clip in clips.values():
        edit(clip, slice(600, 610), 0.25)
    made = commit(gaits, **clips)
    monkeypatch.setattr("marey_server.store.datasets.portable.MOST_BYTES_AT_ONCE", 1)
    monkeypatch.setattr("marey_client.archives.receiving.LEAST_BYTES_SHARED", 1)
    assert_copied(partner, gaits, made)
    sizes = [size for path, size in sent if path.endswith("/gaits/contents")]
    assert sizes[-1] < sizes[-2] / 2
    assert (poses_in(partner) == clips["walk"].part("motion")["poses"]).all()


def test_a_push_of_one_relabelled_clip_sends_less_than_twenty_kilobytes_in_all(
    lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle, sent: list[tuple[str, int]]
) -> None:
    clips = {f"clip {number}": make_walk(lab, f"clip {number}", 3) for number in range(20)}
    assert_copied(partner, gaits, commit(gaits, **clips))
    clips["clip 7"].put_part("info", {"schema": "marey/clip-info@1", "comment": "second"})
    made = commit(gaits, **clips)
    sent.clear()
    assert partner.datasets.pull(gaits, "gaits").commit == made
    assert len(sent) <= 12
    assert sum(size for _, size in sent) < 20_000


def test_a_copy_moves_no_tag_of_the_target_and_says_so(
    lab: ProjectHandle, partner: ProjectHandle, gaits: DatasetHandle
) -> None:
    first = commit(gaits, rig=make_rig(lab))
    partner.datasets.pull(gaits, "gaits")
    partner.datasets.at("gaits").create_tag("v1", first.digest)
    second = commit(gaits, tall=make_rig(lab, joints=3, name="tall"))
    made = partner.datasets.pull(gaits, "gaits", into="v1")
    assert (made.commit, made.branch, made.moved) == (second, "v1", False)
    assert partner.datasets.at("gaits").at("v1") == first
    assert partner.datasets.at("gaits").at(second.digest) == second

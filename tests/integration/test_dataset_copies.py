"""Copies of versions to another project: documents may refer to content of other entries, or of later versions."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.support.rest_server import Server
from tests.support.store_fixtures import motion_tree, skeleton_tree

from marey_client import Marey
from marey_client.blobs import Blobs
from marey_client.handles.versions import DatasetHandle
from marey_client.items import ItemHandle
from marey_client.project import ProjectHandle
from marey_client.transport import Transport
from marey_schemas.access import ProjectCreate, Role
from marey_schemas.datasets.commits import Commit, PutEntry, RemoveEntry
from marey_schemas.kinds import Kind


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


def make_rig(lab: ProjectHandle, joints: int = 2) -> ItemHandle:
    return lab.skeletons.create("rig", {"hierarchy": skeleton_tree(joints)})


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

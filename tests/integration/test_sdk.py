"""The SDK as people use it in a script or a notebook, with a real server."""

import html
import os
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from tests.support.rest_server import Server

import marey
from marey_client.errors import MissingPackage, NoSuchJoint, NoSuchPath
from marey_client.project import ProjectHandle
from marey_motion.documents import clip_to_document, skeleton_to_document
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_motion.kinematics import foot_contacts, global_positions, velocities
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.skeletons import SkeletonMapping

WALK = generate_gait(1.3, 0.2, 2.0)


@pytest.fixture
def lab(server: Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[ProjectHandle]:
    """The project `lab`; server and token are read from environment variables, as by the command line."""
    monkeypatch.setenv("MAREY_SERVER", server.address)
    monkeypatch.setenv("MAREY_TOKEN", server.make_project())
    with marey.connect() as client:
        yield client.project("lab")


@pytest.fixture
def takes(tmp_path: Path) -> Path:
    """A folder with two walks of different people, and files that cannot be imported."""
    folder = tmp_path / "takes"
    folder.mkdir()
    (folder / "walk.bvh").write_bytes(write_bvh(WALK))
    (folder / "run.bvh").write_bytes(write_bvh(generate_gait(2.2, 0.0, 3.0)))
    (folder / "broken.bvh").write_text("HIERARCHY\nROOT")
    (folder / "notes.txt").write_text("windy")
    return folder


def test_a_folder_becomes_clips_that_are_found_by_path_and_listed_in_a_table(lab: ProjectHandle, takes: Path) -> None:
    report = lab.upload(takes, collection="raw", subject="ada", shown=True)
    assert "3 files: 2 created, 1 failed" in str(report)
    assert "broken.bvh" in str(report)
    assert "notes.txt" in report._repr_html_()
    assert sorted(clip.path for clip in report.clips()) == ["raw/run", "raw/walk"]
    assert "2 unchanged" in lab.upload(str(takes), collection="raw", subject="ada").summary

    walk = lab.clips["raw/walk"]
    assert lab.clips[walk.id].path == lab.clips["lab/raw/walk"].path == "raw/walk"
    assert (len(lab.clips), [clip.name for clip in lab.clips]) == (2, ["run", "walk"])
    assert "raw/walk" in lab.clips
    assert "raw/swim" not in lab.clips
    assert (walk.frames, walk.frame_rate_hz, walk.duration_s) == (120, 60.0, 2.0)
    long = lab.clips.where("raw", query="frames > 150")
    assert (len(long), [clip.name for clip in long]) == (1, ["run"])
    table = lab.clips.to_dataframe()
    assert table.loc[walk.id, ["path", "frames", "subject"]].tolist() == ["raw/walk", 120, "ada"]
    assert lab.clips.where(query="frames < 1").to_dataframe().empty


def test_a_misspelt_path_names_the_nearest(lab: ProjectHandle, takes: Path) -> None:
    lab.upload(takes / "walk.bvh", collection="raw")
    for path, message in {
        "raw/wlak": "there is no clip 'wlak' in raw; did you mean 'raw/walk'?",
        "rwa/walk": "there is no folder 'rwa' in lab; did you mean 'raw'?",
        "rwa": "there is no clip 'rwa' in lab; did you mean 'raw'?",
        "raw": "'raw' is a folder of lab; clips.where('raw') selects the clips in it",
        "qqqq": "there is no clip 'qqqq' in lab; it has raw, skeletons",
        "raw/qqqq": "there is no clip 'qqqq' in raw; it has walk",
        "skeletons/walk": "there is no clip 'walk' in skeletons; no clips are directly in it",
    }.items():
        with pytest.raises(NoSuchPath) as told:
            lab.clips[path]
        assert str(told.value) == message
    with pytest.raises(NoSuchPath, match="no folder 'rwa'"):
        lab.clips.where("rwa")
    with pytest.raises(NoSuchPath, match="did you mean 'raw'"):
        lab.index("rwa")


def stored(lab: ProjectHandle) -> Any:
    """Store the walk without rounding, and return its handle."""
    rig = lab.skeletons.create("rig", {"hierarchy": skeleton_to_document(WALK.skeleton).model_dump(by_alias=True)})
    motion = clip_to_document(WALK, RevisionRef(item=rig.id, revision=1))
    return lab.clips.create("walk", {"motion": motion.model_dump(by_alias=True, exclude_none=True)})


def test_arrays_are_those_of_the_library_and_only_what_is_asked_for_is_read(
    lab: ProjectHandle, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip = stored(lab)
    every = global_positions(WALK)
    names = WALK.skeleton.joint_names
    feet = ["RightToeBase", "LeftToeBase"]
    columns = [names.index(name) for name in feet]
    assert clip.joints() == names
    np.testing.assert_allclose(clip.positions(), every, atol=1e-6)
    asked: list[dict[str, Any]] = []
    read = type(clip).motion

    def noted(self: Any, **query: Any) -> Any:
        asked.append(query)
        return read(self, **query)

    monkeypatch.setattr(type(clip), "motion", noted)
    some = clip.positions(joints=feet, frames=slice(20, 50))
    np.testing.assert_allclose(some, every[20:50, columns], atol=1e-6)
    (query,) = asked
    assert query["frames"] == slice(20, 50)
    assert set(query["joints"]) < set(names)
    assert "LeftHand" not in query["joints"]
    whole = velocities(every, 60.0)
    for frames in (slice(0, 10), slice(50, 60), slice(110, None), None):
        expected = whole[frames or slice(None)][:, columns]
        np.testing.assert_allclose(clip.velocities(joints=feet, frames=frames), expected, atol=1e-4)
    toes = foot_contacts(every[:, columns[::-1]], 60.0)
    mapping = {"left_toe": "LeftToeBase", "right_toe": "RightToeBase"}
    lab.skeletons["rig"].put_mapping(SkeletonMapping(joints=mapping))
    clip = lab.clips["walk"]
    np.testing.assert_array_equal(clip.contacts(), toes)
    np.testing.assert_array_equal(clip.contacts(frames=slice(30, 45)), toes[30:45])
    assert clip.rotations(joints="Hips", frames=slice(0, 2)).shape == (2, 1, 4)
    with pytest.raises(ValueError, match="frames are counted from 0"):
        clip.velocities(frames=slice(0, -5))
    for frames in (slice(clip.frames, None), slice(50, 50)):
        for method in (clip.positions, clip.velocities, clip.contacts):
            with pytest.raises(marey.MareyError, match="frames"):
                method(frames=frames)
    with pytest.raises(NoSuchJoint, match="did you mean 'LeftHand'"):
        clip.positions(joints="lefthand")


def test_clips_become_tables_and_pictures(lab: ProjectHandle, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    clip = stored(lab)
    part: dict[str, Any] = {"joints": ["Hips", "Head"], "frames": slice(30, 60)}
    positions = clip.positions(**part)
    table = clip.to_dataframe(**part)
    np.testing.assert_array_equal(table["Hips"]["y"], positions[:, 0, 1])
    assert (table.index[0], table.attrs["unit"], isinstance(table, pandas.DataFrame)) == (0.5, "m", True)
    arrow = clip.to_arrow(**part)
    assert arrow.column_names == ["frame", "time_s", "Hips", "Head"]
    np.testing.assert_array_equal(np.array(arrow["Head"].to_pylist(), np.float32), positions[:, 1])
    labelled = clip.to_xarray(**part)
    np.testing.assert_array_equal(labelled.positions.sel(joint="Head"), positions[:, 1])
    assert labelled.rotations.dims == ("time_s", "joint", "component")

    picture = clip.plot(frames=slice(0, 60), moments=3)
    assert [f"frame {frame}" in picture.svg for frame in (0, 30, 59, 60)] == [True, True, True, False]
    assert picture.save(tmp_path / "walk.svg").read_text("utf-8") == picture.svg
    assert "<svg" in clip._repr_html_()
    monkeypatch.setitem(sys.modules, "marey_reports.drawing.strips", None)
    monkeypatch.setitem(sys.modules, "pandas", None)
    assert "pip install 'marey[figures]'" in html.unescape(clip._repr_html_())
    with pytest.raises(MissingPackage, match=r"pip install 'marey\[notebook\]'"):
        clip.to_dataframe()


def test_windows_are_read_when_needed_and_people_stay_in_one_part(lab: ProjectHandle, takes: Path) -> None:
    for subject in ("ada", "bob", "cy"):
        lab.upload(takes / "walk.bvh", collection=subject, subject=subject)
    windows = marey.MotionWindows(lab.clips, frames=60, stride=30, content="positions", joints=["Hips"], seed=7)
    pickled = pickle.dumps(windows)
    assert os.environ["MAREY_TOKEN"].encode() not in pickled
    again = pickle.loads(pickled)
    assert len(windows) == len(again) == 9
    assert {(one.clip.path, one.first) for one in windows.windows} == {
        (f"{subject}/walk", first) for subject in ("ada", "bob", "cy") for first in (0, 30, 60)
    }
    one = again[4]
    expected = lab.clips[one["clip"]].positions(joints="Hips")[one["first"] : one["first"] + 60]
    np.testing.assert_array_equal(one["motion"], expected)
    np.testing.assert_array_equal(windows[4]["motion"], expected)
    parts = windows.split({"train": 0.7, "test": 0.3}, seed=1)
    assert {name: len(part) for name, part in parts.items()} == {"train": 6, "test": 3}
    people = [{window.clip.item.summary["subject"] for window in part.windows} for part in parts.values()]
    assert not people[0] & people[1]
    with pytest.raises(ValueError, match="has no take"):
        windows.split({"train": 1.0}, by="take")


def test_a_job_is_a_handle_that_can_be_cancelled_and_says_so(lab: ProjectHandle, takes: Path) -> None:
    lab.upload(takes / "walk.bvh", collection="raw")
    (rig,) = lab.skeletons
    job = lab.retarget("raw/walk", rig.path, into="there")
    assert (job.inputs["clips"][0]["item"], job.state) == (lab.clips["raw/walk"].id, "queued")
    assert repr(job) == f"<job retarget {job.id} queued>"
    assert lab.job(job.id).cancel().state == "cancelled"
    with pytest.raises(marey.JobUnsuccessful, match="was cancelled"):
        job.wait()
    assert job.wait(require_success=False).state == "cancelled"
    assert [one.id for one in lab.jobs()] == [job.id]
    assert list(job.outputs()) == []

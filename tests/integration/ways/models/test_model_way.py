"""Workflow of a model: aligned clips, training and samples, on a real server with a real worker."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.command_line import CommandLine

from marey_client.errors import JobUnsuccessful, RequestFailed
from marey_client.handles.models import ModelHandle
from marey_client.poses.player_pages import motions_of_samples
from marey_client.project import ProjectHandle
from marey_motion.formats import read_motion

pytestmark = pytest.mark.timeout(300)

EXAMPLES = 12


QUICK: dict[str, Any] = {"report_samples": 20, "spatial_components": 1, "seed": 5}
"""Options of a model whose report has one component and figures of few samples."""


@pytest.fixture(scope="module")
def walk(lab: ProjectHandle) -> ModelHandle:
    return lab.model(lab.train_model("aligned", name="walk", into="models", tags=("nightly",), **QUICK))


def test_a_model_tells_how_good_it_is_and_what_it_was_made_of(lab: ProjectHandle, walk: ModelHandle) -> None:
    assert (walk.path, walk.item.tags) == ("models/walk", ("nightly",))
    summary = walk.summary()
    assert summary["examples"] == EXAMPLES
    assert 0.0 < summary["left_out_error_cm"] < 5.0
    assert walk.verdict.startswith(f"{EXAMPLES} examples in ")
    assert {edge.item for edge in walk.lineage().inputs} == {one.id for one in lab.processed.list(collection="aligned")}
    assert not walk.staleness().stale
    document = walk.document()
    assert document["provenance"]["seed"] == 5
    assert document["options"]["scaling"] == "jacobian"
    assert {one["name"] for one in document["training"]["examples"]} == {
        f"walks/walk {index:02}" for index in range(EXAMPLES)
    }
    (listed,) = lab.models.list(filters={"skeleton": document["skeleton"]["item"]})
    assert listed.id == walk.id


@pytest.mark.soak
def test_the_same_clips_options_and_seed_make_the_same_model(lab: ProjectHandle, walk: ModelHandle) -> None:
    again = lab.model(lab.train_model("aligned", name="walk", into="again", cache="off", **QUICK))
    assert again.item.parts["model"].document == walk.item.parts["model"].document
    assert again.item.parts["report"].document == walk.item.parts["report"].document


def test_clips_that_were_not_aligned_together_are_refused_by_name(lab: ProjectHandle) -> None:
    with pytest.raises(JobUnsuccessful, match=r"walk .*not aligned together"):
        lab.model(lab.train_model(("aligned", "others"), name="mixed"))


def test_a_model_has_a_report_with_its_figures(walk: ModelHandle, tmp_path: Path) -> None:
    page = walk.report().decode()
    assert page.startswith("<!DOCTYPE html>")
    assert walk.verdict.split(".")[0] in page
    figures = {figure.name: figure for figure in walk.figures()}
    assert {"time-warps", "alignment-costs", "mean", "samples", "component-1", "likelihood"} <= set(figures)
    assert all(figure.caption for figure in figures.values())
    assert walk.figure("samples").startswith(b"\x89PNG")
    assert b"<svg" in walk.figure("samples", "svg")
    rows = walk.figure("time-warps", "csv", table="clips").decode().splitlines()
    assert len(rows) == 1 + EXAMPLES
    saved = walk.save_figures(tmp_path / "figures")
    assert "samples.png" in {file.name for file in saved}


def test_the_report_is_a_page_that_may_load_nothing(walk: ModelHandle) -> None:
    answer = walk.transport.send("GET", f"{walk.url}/report", headers={"Accept": "text/html"})
    policy = answer.headers["Content-Security-Policy"].split("; ")
    assert "default-src 'none'" in policy
    assert "sandbox allow-scripts" in policy
    assert any(rule.startswith("script-src 'sha256-") for rule in policy)
    figure = walk.transport.send("GET", f"{walk.url}/figures/mean", params={"format": "svg"}, headers={"Accept": "*/*"})
    assert figure.headers["Content-Security-Policy"].endswith("; sandbox")


def test_samples_are_the_same_for_the_same_seed_and_begin_alike(walk: ModelHandle) -> None:
    few, many, others = walk.sample(2, 7), walk.sample(5, 7), walk.sample(2, 8)
    assert np.array_equal(few.latents, many.latents[:2])
    for one, same in zip(few.motions, many.motions, strict=False):
        assert np.array_equal(one.poses, same.poses)
    assert not np.array_equal(few.latents, others.latents)
    for motion in many.motions:
        lengths = np.linalg.norm(motion.rotations.astype(np.float64), axis=2)
        np.testing.assert_allclose(lengths, 1.0, atol=1e-6)
        np.testing.assert_allclose(motion.root_translations[0, [0, 2]], 0.0, atol=0.05)
        assert motion.skeleton.model_dump() == walk.document()["skeleton"]
    assert np.isfinite(many.log_densities).all()


def test_samples_become_files_that_read_back(walk: ModelHandle, tmp_path: Path) -> None:
    drawn = walk.sample(3, 7).motions
    for form in ("bvh", "npz"):
        files = walk.save_samples(tmp_path / form, form, n=3, seed=7)
        assert len({file.name for file in files}) == 3
        for file, motion in zip(files, drawn, strict=True):
            clip = read_motion(file.read_bytes(), file.name).clip
            assert clip is not None
            assert clip.frame_count == len(motion.poses)
            np.testing.assert_allclose(clip.root_translations, motion.root_translations, atol=1e-5)
    (single,) = walk.save_samples(tmp_path / "one", "bvh", seed=7)
    assert single.read_bytes() == (tmp_path / "bvh" / "walk_7_0001.bvh").read_bytes()
    for file in walk.save_samples(tmp_path / "predecessor", "predecessor", n=2, seed=7):
        assert file.read_bytes().startswith(b"BZh")
    (document,) = walk.save_samples(tmp_path / "json", "json", n=2)
    assert json.loads(document.read_bytes())["schema"] == "marey/motion-samples@1"


def test_an_archive_of_samples_is_the_same_bytes_every_time(walk: ModelHandle) -> None:
    def archive() -> bytes:
        params = {"n": "3", "seed": "1", "format": "bvh"}
        return walk.transport.send(
            "GET", f"{walk.url}/samples/export", params=params, headers={"Accept": "*/*"}
        ).content

    first = archive()
    assert first == archive()
    assert zipfile.ZipFile(io.BytesIO(first)).namelist() == [f"walk_1_000{place}.bvh" for place in (1, 2, 3)]


def test_samples_become_clips_on_the_models_skeleton(lab: ProjectHandle, walk: ModelHandle) -> None:
    made = walk.add_samples(2, 3, into="drawn")
    assert [clip.path for clip in made] == ["drawn/walk_3_0001", "drawn/walk_3_0002"]
    for clip, motion in zip(made, walk.sample(2, 3).motions, strict=True):
        assert np.array_equal(clip.motion().poses, motion.poses)
        source = clip.info().source
        assert source is not None
        assert source.details["model"]["item"] == walk.id


def test_a_client_that_holds_the_samples_is_not_sent_them_again(walk: ModelHandle) -> None:
    path, params = f"{walk.url}/samples", {"n": "2", "seed": "4"}
    first = walk.transport.send("GET", path, params=params)
    again = walk.transport.send("GET", path, params=params, headers={"If-None-Match": first.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")
    other = walk.transport.send("GET", path, params={**params, "seed": "5"})
    assert other.headers["ETag"] != first.headers["ETag"]


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ({"n": "0"}, 400),
        ({"n": "1001"}, 400),
        ({"seed": "-1"}, 400),
        ({"format": "fbx"}, 400),
        ({"revision": "9"}, 404),
    ],
)
def test_questions_that_make_no_sense_are_refused(walk: ModelHandle, query: dict[str, Any], status: int) -> None:
    with pytest.raises(RequestFailed) as caught:
        walk.transport.send("GET", f"{walk.url}/samples/export", params=query)
    assert caught.value.status == status


def test_only_models_have_samples(lab: ProjectHandle) -> None:
    clip = next(iter(lab.clips.list()))
    with pytest.raises(RequestFailed, match="generated only from models"):
        lab.transport.send("GET", f"{clip.url}/samples")


def test_from_the_command_line(lab: ProjectHandle, run: CommandLine, tmp_path: Path) -> None:
    told = run("model", "lab/aligned", "--name", "cli", "--into", "models", "--share", "0.9", "--no-report").stdout
    assert told.startswith(f"{EXAMPLES} examples in ")
    assert "left out, cm" in told
    files = run("sample", "lab/models/cli", "-n", "2", "--seed", "1", "--out", "samples").stdout.split("\n")
    assert [Path(file).name for file in files if file] == ["cli_1_0001.bvh", "cli_1_0002.bvh"]
    assert (tmp_path / "samples" / "cli_1_0002.bvh").read_bytes().startswith(b"HIERARCHY")
    clips = json.loads(run("sample", "lab/models/cli", "--into", "from-cli", "--json").stdout)
    assert clips == {"clips": ["lab/from-cli/cli_0_0001"]}
    model = lab.models["models/cli"]
    samples = motions_of_samples(model, None, 2, 1)
    assert [one.name for one in samples] == ["sample 1", "sample 2"]
    assert (samples[1].motion.poses == model.sample(2, 1).motions[1].poses).all()
    run("view", "lab/models/cli", "-n", 2, "--seed", 1, "--moments", 3, "--out", "samples.svg")
    drawn = (tmp_path / "samples.svg").read_text(encoding="utf-8")
    assert [drawn.count(f">{text}<") for text in ("sample 1", "sample 2", "sample 3", "50 %")] == [1, 1, 0, 1]
    assert "no clip at lab/models/cli" in run("view", "lab/models/cli", status=2).stderr
    shown = run("show", "lab/models/cli").stdout
    assert "verdict" in shown
    assert "left_out_error_cm" in shown
    assert "no part" in run("report", "lab/models/cli", status=1).stderr
    assert run("report", "lab/models/walk", "--out", "walk.html", "--figures", "drawn").stdout == "walk.html\n"
    assert (tmp_path / "walk.html").read_bytes().startswith(b"<!DOCTYPE html>")
    assert (tmp_path / "drawn" / "component-1.svg").is_file()
    assert "not a format" in run("sample", "lab/models/cli", "--format", "fbx", status=2).stderr

"""Workflow of a studio whose performers' consents end: the commands of the how-to page, on a real server."""

from __future__ import annotations

import json
import re
import subprocess
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine
from tests.support.present import present

from marey_client.handles.clips import ClipHandle
from marey_client.marey import Marey
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_versions.archive.reading import Archive

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "respect-consents.md"


def commands() -> list[list[str]]:
    """Return the arguments of the commands of the page, as a shell splits them."""
    lines = re.findall(r"^marey (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    found = []
    for line in lines:
        script = f"printf '%s\\0' {line}\n"
        shown = subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=True).stdout
        found.append(shown.split("\0")[:-1])
    return found


@pytest.fixture
def project(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ProjectHandle:
    """A project with the clips `walk` and `turn` in the folder `raw`, and a dataset of this folder."""
    for name, step in (("walk", 0.5), ("turn", 0.6)):
        (tmp_path / f"{name}.bvh").write_bytes(write_bvh(generate_gait(1.3, step, 1.0)))
    made = lab_of(tmp_path / "walk.bvh", tmp_path / "turn.bvh", collection="raw")
    made.datasets.create("gaits", collection="raw")
    return made


def clip(project: ProjectHandle, name: str, collection: str | None = None) -> ClipHandle:
    (found,) = (one for one in project.clips.list(collection=collection) if one.name == name)
    return found


def set_consent(project: ProjectHandle, name: str, days: int) -> None:
    """Set the last day of the consent for a clip to some days after today."""
    until = datetime.now(UTC).date() + timedelta(days=days)
    found = clip(project, name)
    found.put_info(found.info().model_copy(update={"consent_until": until}))


def overrides(project: ProjectHandle) -> list[tuple[str, int]]:
    """Return, for each export that was allowed without a valid consent, the reason and the number of clips."""
    page = project.transport.send("GET", f"{project.url}/events", params={"limit": 1000}).json()["items"]
    return [(one["body"]["reason"], one["body"]["count"]) for one in page if one["kind"] == "consent.overridden"]


def test_the_page_finds_refuses_and_allows(run: CommandLine, project: ProjectHandle, marey: Marey) -> None:
    record, ended, soon, without, *_withdrawn, download, archive, submit, webhook = commands()
    run(*record)
    set_consent(project, "turn", 10)
    gaits = project.datasets.at("gaits")
    gaits.commit("First takes")
    gaits.create_tag("v1")
    for query, names in ((ended, {"walk"}), (soon, {"walk", "turn"}), (without, set())):
        listed = json.loads(run(*query, "--json").stdout)["items"]
        assert {one["name"] for one in listed} == names, query

    # refused, with the clip, the day and the remedies
    refusal = run("download", "lab/raw", "-o", "all", status=1)
    assert "wrote 1 file" in refusal.stdout
    for said in ("walk", "2026-01-31", "consent_until", "maintainer", "allow_expired_consent", "consent-expired"):
        assert said in refusal.stdout + refusal.stderr, said
    run(*archive[:4], status=1)
    assert not (run.folder / archive[3]).exists()
    run(*submit[: submit.index("--param")], status=1)
    (job,) = (one for one in project.jobs() if one.kind == "export")
    assert [one["code"] for one in present(job.result)["refused"]] == ["consent-expired"]
    assert overrides(project) == []

    # allowed
    run(*download)
    assert [one.name for one in (run.folder / "out").iterdir()] == ["walk.bvh"]
    run(*archive)
    with (run.folder / archive[3]).open("rb") as file:
        opened = Archive(file)
        assert {one.path for one in opened.versions().entries(opened.manifest.commit)} >= {"walk", "turn"}
    run(*submit)
    job = next(one for one in project.jobs() if one.params.get("allow_expired_consent"))
    assert present(job.result)["consent_ended"] == [clip(project, "walk").id]
    with zipfile.ZipFile(marey.blobs.fetch_to(present(job.result)["archive"]["blob"], run.folder / "x.zip")) as held:
        assert sorted(held.namelist()) == ["raw/turn.bvh", "raw/walk.bvh"]
    reasons = [download[-1], archive[-1], submit[-1].partition("=")[2]]
    assert overrides(project) == [(reason, 1) for reason in reasons]
    run(*webhook)


def test_the_page_deletes_the_recordings_of_a_performer_for_good(run: CommandLine, project: ProjectHandle) -> None:
    listed, lineage, remove, preview, purge = commands()[4:9]
    run("record", "lab/raw/walk", "--set", "subject=02")
    walk = clip(project, "walk")
    assert [one["name"] for one in json.loads(run(*listed, "--json").stdout)["items"]] == ["walk"]
    assert "raw/walk" in run(*lineage).stdout
    run(*remove, "--yes")
    assert "lab/raw/walk" in run(*preview).stdout
    assert "1 item purged for good" in run(*purge, "--yes").stderr
    assert [one.name for one in project.clips.list()] == ["turn"]
    assert list(project.clips.list(deleted=True)) == []
    page = project.transport.send("GET", f"{project.url}/events", params={"limit": 1000}).json()["items"]
    of_walk = [one for one in page if one["subject"] == walk.id]
    assert of_walk[-1]["kind"] == "item.purged"
    assert all("walk" not in json.dumps(one["body"]) for one in of_walk)


def test_an_archive_with_an_earlier_version_of_a_deleted_clip_is_refused(
    run: CommandLine, project: ProjectHandle
) -> None:
    gaits = project.datasets.at("gaits")
    gaits.commit("First takes")
    set_consent(project, "walk", -1)
    run("rm", "lab/raw/walk", "--kind", "clip")
    gaits.commit("Without the walk")
    refusal = run("archive", "create", "lab/gaits", "gaits.tar", status=1)
    assert "raw/walk" in refusal.stderr
    run("archive", "create", "lab/gaits", "gaits.tar", "--since", "main~1", status=0)


def test_an_archive_of_annotations_does_not_hide_their_clips(run: CommandLine, project: ProjectHandle) -> None:
    """The annotations refer to clips, so the archive also contains the motion of these clips."""
    run("annotation", "propose", "lab/raw/walk", "--into", "said")
    project.datasets.create("said", collection="said")
    project.datasets.at("said").commit("Steps")
    set_consent(project, "walk", -1)
    refusal = run("archive", "create", "lab/said", "said.tar", status=1)
    assert "consent-expired" in refusal.stderr
    assert overrides(project) == []
    run("archive", "create", "lab/said", "said.tar", "--allow-expired-consent", "why")
    assert overrides(project) == [("why", 1)]


def test_a_copy_takes_the_record_along_and_the_other_project_refuses_the_export(
    run: CommandLine, project: ProjectHandle
) -> None:
    set_consent(project, "walk", -1)
    project.datasets.at("gaits").commit("First takes")
    run("project", "create", "away")
    run("dataset", "push", "lab/gaits", "away/gaits")
    run("dataset", "checkout", "away/gaits")
    refusal = run("download", "away/gaits", "-o", "out", status=1)
    assert "wrote 1 file" in refusal.stdout
    assert "consent-expired" in refusal.stdout + refusal.stderr
    run("archive", "create", "away/gaits", "away.tar", status=1)
    ProjectHandle(project.transport, "away").delete()


def test_results_of_jobs_keep_the_record_of_their_source(run: CommandLine, project: ProjectHandle) -> None:
    set_consent(project, "walk", -1)
    set_consent(project, "turn", 10)
    ended = clip(project, "walk").info()
    run("annotation", "propose", "lab/raw", "--into", "said")
    run("cut", "lab/said", "--into", "cut")
    (rig,) = project.skeletons.list()
    run("retarget", "lab/raw", "--to", f"lab/{rig.path}", "--into", "retargeted")
    run("edit", "apply", "lab/raw/walk", "--do", "mirror", "--into", "mirrored")
    run("align", "lab/raw", "--into", "aligned")
    made = [one for folder in ("cut", "retargeted", "mirrored") for one in project.clips.list(collection=folder)]
    of_walk = [one for one in made if "walk" in one.name]
    assert {one.item.collection.partition("/")[0] for one in of_walk} == {"cut", "retargeted", "mirrored"}
    assert {one.info().consent_until for one in of_walk} == {ended.consent_until}
    for folder in ("cut", "retargeted", "mirrored", "aligned"):
        refusal = run("download", f"lab/{folder}", "--format", "bvh", "-o", folder, status=1)
        text = refusal.stdout + refusal.stderr
        assert "consent-expired" in text, folder
        assert not any("walk" in path.name for path in (run.folder / folder).rglob("*.bvh")), folder


def test_a_joined_clip_has_the_consent_of_both(run: CommandLine, project: ProjectHandle) -> None:
    set_consent(project, "turn", -1)
    turn = clip(project, "turn").id
    run("edit", "apply", "lab/raw/walk", "--do", f"concatenate source={turn}", "--into", "joined")
    joined = clip(project, "walk", "joined")
    assert joined.info().consent_until == clip(project, "turn").info().consent_until
    run("download", "lab/joined", "--format", "bvh", status=1)

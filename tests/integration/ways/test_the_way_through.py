"""Workflow through all main features, with command line and SDK, on a real server with a real worker."""

import contextlib
import hashlib
import json
import os
import re
import subprocess
import zipfile
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from tests.support.command_line import CommandLine, run_here
from tests.support.patience import PATIENCE_S
from tests.support.present import present
from tests.support.server_process import ServerProcess

from marey_client import errors
from marey_client.handles.clips import ClipHandle
from marey_client.handles.skeletons import SkeletonHandle
from marey_client.imports import FILES_PER_IMPORT, find_files
from marey_client.marey import Marey
from marey_client.project import ProjectHandle
from marey_motion.formats import read_motion, write_bvh
from marey_motion.gait import game_skeleton, generate_gait
from marey_schemas.access import Login, ProjectCreate, UserCreate
from marey_schemas.documents.skeletons import SkeletonMapping
from marey_schemas.imports import ImportFile
from marey_schemas.items import ItemChange
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue.job_params import ImportParams
from marey_schemas.queue.jobs import CollectionInput, ItemInput, JobCreate

pytestmark = pytest.mark.parametrize("server", ["sqlite"], indirect=True, scope="session")


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a walk and a broken file, and a subfolder with another walk."""
    folder = tmp_path_factory.mktemp("takes")
    (folder / "turns").mkdir()
    (folder / "walk.bvh").write_bytes(write_bvh(generate_gait(1.3, 0.0, 2.0)))
    (folder / "turns" / "left.bvh").write_bytes(write_bvh(generate_gait(1.2, 0.8, 1.5)))
    (folder / "broken.bvh").write_bytes(b"HIERARCHY\nROOT Hips\n{\n  OFFSET 0 0 nonsense\n")
    return folder


@pytest.fixture
def project(marey: Marey, request: pytest.FixtureRequest) -> ProjectHandle:
    name = hashlib.sha1(request.node.name.encode()).hexdigest()[:12]
    return marey.create_project(ProjectCreate(name=name))


def target_skeleton(project: ProjectHandle) -> SkeletonHandle:
    """Create a skeleton of another rig in the project, and return its handle."""
    from marey_motion.documents import mapping_to_document, skeleton_to_document
    from marey_motion.rigs import guess_axes, map_joints

    skeleton = game_skeleton()
    mapping = map_joints(skeleton)
    parts = {
        "hierarchy": skeleton_to_document(skeleton),
        "mapping": mapping_to_document(mapping, guess_axes(skeleton, mapping)),
    }
    trees = {name: part.model_dump(by_alias=True, exclude_none=True) for name, part in parts.items()}
    return project.skeletons.create("studio", trees)


@pytest.mark.check
def test_the_readme_told_in_a_shell(run: CommandLine, takes: Path, tmp_path: Path, marey: Marey) -> None:
    run("project", "create", "readme")
    upload = run("upload", takes, "--project", "readme", "--collection", "raw", "--json", status=1)
    entries = {entry["name"]: entry for entry in json.loads(upload.stdout)}
    assert entries["walk.bvh"]["status"] == entries["turns/left.bvh"]["status"] == "created"
    assert entries["broken.bvh"]["error"]["line"] == 4
    assert "walk" in run("ls", "readme/raw").stdout
    assert "left" not in run("ls", "readme/raw").stdout
    assert "raw/turns/left" in run("ls", "readme/raw", "-r").stdout

    studio = target_skeleton(marey.project("readme"))
    told = run("retarget", "readme/raw", "--to", f"readme/{studio.id}", "--into", "studio").stdout
    assert "2 clips" in told
    assert "0 refused" in told
    run("download", "readme/studio", "--format", "bvh", "-o", tmp_path / "out")
    files = sorted(path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.bvh"))
    assert files == ["raw/turns/left.bvh", "raw/walk.bvh"]
    back = read_motion((tmp_path / "out/raw/walk.bvh").read_bytes(), "walk.bvh").clip
    assert present(back).frame_count == 120
    assert present(back).skeleton.joint_names == game_skeleton().joint_names

    history = json.loads(run("show", "readme/studio/raw/walk", "--history", "--json").stdout)
    assert {edge["kind"] for edge in history["lineage"]["inputs"]} == {"clip", "skeleton"}
    jobs = json.loads(run("job", "ls", "readme", "--json").stdout)
    assert "succeeded" in run("why", jobs[0]["id"]).stdout
    assert json.loads(run("job", "show", jobs[0]["id"], "--json").stdout)["result"]["clips"] == 2
    assert listed(run, "readme", "--kind", "retarget") == [jobs[0]["id"]]
    assert listed(run, "readme", "--kind", "evaluate", "--kind", "retarget", "--state", "succeeded") == [jobs[0]["id"]]
    assert listed(run, "readme", "--kind", "evaluate") == listed(run, "readme", "--author", "nobody") == []
    assert listed(run, "readme", "--tasks-of", jobs[0]["id"]) == []


def listed(run: CommandLine, *arguments: str) -> list[str]:
    return [one["id"] for one in json.loads(run("job", "ls", *arguments, "--json").stdout)]


def test_a_folder_is_listed_with_what_stands_directly_in_it(run: CommandLine, takes: Path) -> None:
    run("project", "create", "folders")
    run("upload", takes / "turns", "--project", "folders")
    run("upload", takes / "turns", "--project", "folders", "--collection", "a/b")
    for place, folders, names in (
        ("folders", ["a", "skeletons"], ["left"]),
        ("folders/a", ["b"], []),
        ("folders/a/b", [], ["left"]),
    ):
        shown = json.loads(run("ls", place, "--json").stdout)
        assert (shown["collections"], [item["name"] for item in shown["items"]]) == (folders, names)


def test_a_clip_is_shown_with_its_skeleton_its_evidence_and_what_was_noticed(
    run: CommandLine, takes: Path, tmp_path: Path
) -> None:
    text = (takes / "walk.bvh").read_text()
    (tmp_path / "more.bvh").write_text(text.replace("Frames: 120", "Frames: 119"))
    run("project", "create", "shown")
    run("upload", tmp_path / "more.bvh", "--project", "shown", "--unit", "cm")
    (skeleton,) = json.loads(run("ls", "shown/skeletons", "--json").stdout)["items"]
    told = run("show", "shown/more").stdout
    assert f"skeletons/{skeleton['name']} ({skeleton['id']})" in told
    assert "given by the user" in told
    assert "the header declares 119 frames" in told


def test_the_history_of_a_clip_tells_that_its_source_has_changed(
    run: CommandLine, takes: Path, marey: Marey, tmp_path: Path
) -> None:
    run("project", "create", "history")
    run("upload", takes / "walk.bvh", "--project", "history", "--collection", "raw")
    studio = target_skeleton(marey.project("history"))
    kept = run(
        "retarget", "history/raw", "--to", f"history/{studio.id}", "--into", "out", "--keep-feet", "--keep-hands"
    )
    assert "feet-kept" in kept.stderr + kept.stdout
    assert "stale" not in run("show", "--history", "history/out/raw/walk").stdout
    (tmp_path / "walk.bvh").write_bytes(write_bvh(generate_gait(1.3, 0.3, 2.0)))
    run("upload", tmp_path / "walk.bvh", "--project", "history", "--collection", "raw")
    told = run("show", "--history", "history/out/raw/walk").stdout
    assert "stale: clip walk has newer revisions than 1" in told


def test_a_job_of_any_kind_is_handed_in_from_the_shell(run: CommandLine, takes: Path, marey: Marey) -> None:
    run("project", "create", "jobs")
    run("upload", takes / "walk.bvh", "--project", "jobs", "--collection", "raw")
    assert "retarget" in run("job", "kinds").stdout
    assert "skeleton" in run("job", "kinds", "retarget").stdout
    studio = target_skeleton(marey.project("jobs"))
    retarget = ("job", "submit", "jobs", "retarget", "--input", "clips=raw", "--into", "out")
    ended = run(*retarget, "--input", f"skeleton={studio.name}", "--param", "suffix=-x", "--param", "scale=1.5")
    assert json.loads(ended.stdout)["clips"] == 1
    assert [clip.path for clip in marey.project("jobs").clips.list(collection="out")] == ["out/raw/walk-x"]
    assert "their inputs are clips, skeleton" in run(*retarget, "--input", "nose=raw", status=2).stderr
    assert "no skeleton at jobs/absent" in run(*retarget, "--input", "skeleton=absent", status=2).stderr
    assert "the job kinds are import" in run("job", "submit", "jobs", "nothing", status=2).stderr


def test_the_original_comes_back_byte_for_byte(run: CommandLine, takes: Path, tmp_path: Path) -> None:
    run("project", "create", "originals")
    run("upload", takes / "walk.bvh", "--project", "originals")
    run("download", "originals/walk", "-o", tmp_path)
    assert (tmp_path / "walk.bvh").read_bytes() == (takes / "walk.bvh").read_bytes()


def test_refusals_are_one_line_with_a_request_id_and_exit_status_1(run: CommandLine) -> None:
    done = run("project", "show", "absent", status=1)
    assert done.stderr.count("\n") == 1
    assert "request " in done.stderr
    assert done.stdout == ""


def test_a_token_can_be_made_used_and_revoked(run: CommandLine, tmp_path: Path) -> None:
    run("project", "create", "tokens")
    run("token", "create", "reader", "--scope", "read", "--output", tmp_path / "token")
    assert (tmp_path / "token").stat().st_mode & 0o777 == 0o600
    assert "tokens" in run("--token-file", tmp_path / "token", "project", "ls").stdout
    refused = run("project", "create", "more", "--token-file", tmp_path / "token", status=1)
    assert "write" in refused.stderr
    (made,) = [one for one in json.loads(run("token", "ls", "--json").stdout) if one["name"] == "reader"]
    run("token", "revoke", made["id"])
    assert "bad-token" in run("project", "ls", "--token-file", tmp_path / "token", status=1).stderr


def test_a_token_that_leaked_is_found_and_revoked_with_what_was_created_with_it(
    run: CommandLine, tmp_path: Path
) -> None:
    leaked, copied = tmp_path / "leaked", tmp_path / "copied"
    run("token", "create", "leaked", "--days", "3", "--output", leaked)
    run("token", "create", "copied", "--output", copied, "--token-file", leaked)
    listed = ("token", "ls", "--everybody", "--prefix", leaked.read_text().split("_")[1])
    shown = run(*listed, "--expiring", "4").stdout
    assert " days)" in shown  # 2 or 3: the clock of the server may be a second ahead
    (found,) = json.loads(run(*listed, "--json").stdout)
    assert found["user"] == "admin"
    run("token", "rm", found["id"], "--with-created")
    assert "bad-token" in run("project", "ls", "--token-file", copied, status=1).stderr


def test_all_tokens_of_a_user_end_at_once(run: CommandLine, marey: Marey) -> None:
    marey.users.create(UserCreate(name="lea", password="correct horse"))
    session = marey.sign_in(Login(name="lea", password="correct horse"))
    assert [one.id for one in marey.tokens.list(user="lea")] == [session.id]
    assert "no-user" in run("token", "revoke", "--all-of", "nobody", status=1).stderr
    run("token", "revoke", "--all-of", "lea")
    assert list(marey.tokens.list(user="lea")) == []
    assert "--all-of" in run("token", "revoke", status=2).stderr


def test_poses_come_whole_and_in_slices(project: ProjectHandle, takes: Path) -> None:
    project.imports.upload(find_files([takes / "walk.bvh"]).files, ImportOptions(collection="raw"))
    (clip,) = project.clips.list()
    whole = clip.motion()
    expected = read_motion((takes / "walk.bvh").read_bytes(), "walk.bvh").clip
    assert np.array_equal(whole.poses, present(expected).poses)
    some = clip.motion(frames=slice(10, 20), joints=whole.joints[3:5])
    assert np.array_equal(some.root_translations, whole.root_translations[10:20])
    assert np.array_equal(some.rotations, whole.rotations[10:20, 3:5])


def test_items_are_changed_only_as_they_were_read(project: ProjectHandle, takes: Path) -> None:
    project.imports.upload(find_files([takes / "walk.bvh"]).files)
    (clip,) = project.clips.list()
    stale = project.clips.get(clip.id)
    assert clip.change(ItemChange(name="stroll")).name == "stroll"
    with pytest.raises(errors.PreconditionFailed):
        stale.change(ItemChange(name="march"))
    clip.delete()
    assert list(project.clips.list()) == []
    clip.restore()
    assert [one.name for one in project.clips.list()] == ["stroll"]


def test_a_mapping_that_was_edited_is_a_new_revision(project: ProjectHandle) -> None:
    studio = target_skeleton(project)
    mapping = studio.mapping()
    joints = {standard: joint for standard, joint in mapping.joints.items() if standard != "head"}
    assert studio.put_mapping(SkeletonMapping(joints=joints, axes=mapping.axes)).revision == 2
    assert "head" not in studio.mapping().joints
    assert [revision.revision for revision in studio.revisions()] == [2, 1]


def test_files_beyond_one_request_are_imported_and_sent_but_once(project: ProjectHandle, tmp_path: Path) -> None:
    count = FILES_PER_IMPORT + 20
    for number in range(count):
        (tmp_path / f"take-{number:03d}.bvh").write_bytes(write_bvh(generate_gait(1.0 + number / 100, 0.0, 0.1)))
    found = find_files([tmp_path]).files
    first = project.imports.upload(found)
    assert [entry.status for entry in first] == ["created"] * count
    told = []
    again = project.imports.upload(found, notice=lambda *news: told.append(news))
    assert [entry.status for entry in again] == ["unchanged"] * count
    assert not [stage for stage, *_ in told if stage == "sending"]


def test_a_job_imports_what_a_request_would(project: ProjectHandle, marey: Marey, takes: Path) -> None:
    files = find_files([takes]).files
    blobs = [{"name": file.name, "blob": marey.blobs.put_file(file.path)} for file in files]
    params = ImportParams.model_validate({"files": blobs, "collection": "raw", "subject": "ada"})
    job = project.submit(JobCreate(kind="import", params=params.model_dump(mode="json", exclude_defaults=True)))
    ended = marey.jobs.wait(job.id, timeout_s=PATIENCE_S)
    entries = {entry["name"]: entry for entry in present(ended.result)["entries"]}
    assert entries["broken.bvh"]["error"]["line"] == 4
    assert entries["walk.bvh"]["frames"] == 120
    by_job = {clip.path: clip for clip in project.clips.list()}
    assert sorted(by_job) == ["raw/turns/left", "raw/walk"]
    assert by_job["raw/walk"].info().subject == "ada"
    assert len(list(project.skeletons.list())) == 1
    now = {entry.name: entry for entry in project.imports.upload(files, ImportOptions(collection="raw", subject="ada"))}
    assert now["walk.bvh"].status == "unchanged"
    assert now["walk.bvh"].item == by_job["raw/walk"].id


@pytest.mark.parametrize("file_format", ["bvh", "original", "npz", "json"])
def test_an_archive_holds_every_clip_and_is_the_same_each_time(
    project: ProjectHandle, marey: Marey, takes: Path, tmp_path: Path, file_format: str
) -> None:
    project.imports.upload(find_files([takes]).files, ImportOptions(collection="raw"))
    digests = []
    for _ in range(2):
        wanted = JobCreate(
            kind="export",
            inputs={"clips": CollectionInput(collection="raw")},
            params={"format": file_format},
            cache="off",
        )
        ended = marey.jobs.wait(project.submit(wanted).id, timeout_s=PATIENCE_S)
        digests.append(present(ended.result)["archive"]["blob"])
    assert digests[0] == digests[1]
    archive = marey.blobs.fetch_to(digests[0], tmp_path / "clips.zip")
    with zipfile.ZipFile(archive) as held:
        names = {name.rpartition(".")[0]: name for name in held.namelist()}
        assert set(names) == {"raw/walk", "raw/turns/left"}
        if file_format == "original":
            assert held.read(names["raw/walk"]) == (takes / "walk.bvh").read_bytes()


def test_a_clip_that_cannot_be_retargeted_is_a_refusal_and_the_others_are_made(
    project: ProjectHandle, marey: Marey, takes: Path, tmp_path: Path
) -> None:
    project.imports.upload(find_files([takes]).files, ImportOptions(collection="raw"))
    studio = target_skeleton(project)
    lonely = project.skeletons.create(
        "box",
        {"hierarchy": {"schema": "marey/skeleton@1", "joints": [{"name": "Box", "parent": -1, "offset": [0, 0, 0]}]}},
    )
    poses = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], dtype="<f4"), (10, 1))
    motion = {
        "schema": "marey/motion@1", "skeleton": {"item": lonely.id, "revision": 1}, "frame_rate_hz": 30.0,
        "joints": ["Box"], "poses": poses,
    }  # fmt: skip
    project.clips.create("tumbling", {"motion": motion}, collection="raw")
    inputs = {"clips": CollectionInput(collection="raw"), "skeleton": ItemInput(item=studio.id)}
    job = project.submit(JobCreate(kind="retarget", inputs=inputs, into="out"))
    ended = marey.jobs.wait(job.id, timeout_s=PATIENCE_S)
    assert present(ended.result)["clips"] == 2
    (refusal,) = present(ended.result)["refused"]
    assert refusal["name"] == "raw/tumbling"
    assert refusal["code"]
    assert sorted(clip.path for clip in project.clips.list(collection="out")) == ["out/raw/turns/left", "out/raw/walk"]


def test_retargeting_to_a_skeleton_without_a_body_fails_once_and_says_why(
    project: ProjectHandle, marey: Marey, takes: Path
) -> None:
    project.imports.upload(find_files([takes / "walk.bvh"]).files, ImportOptions(collection="raw"))
    box = project.skeletons.create(
        "box",
        {
            "hierarchy": {"schema": "marey/skeleton@1", "joints": [{"name": "Box", "parent": -1, "offset": [0, 0, 0]}]},
            "mapping": {"schema": "marey/skeleton-mapping@1", "joints": {"pelvis": "Sphere"}},
        },
    )
    inputs = {"clips": CollectionInput(collection="raw"), "skeleton": ItemInput(item=box.id)}
    with pytest.raises(errors.JobUnsuccessful, match="Sphere") as caught:
        marey.jobs.wait(project.submit(JobCreate(kind="retarget", inputs=inputs, into="out")).id, timeout_s=PATIENCE_S)
    assert len(list(marey.jobs.attempts(caught.value.job.id))) == 1


def test_results_keep_the_licence_and_say_what_was_done(project: ProjectHandle, marey: Marey, takes: Path) -> None:
    options = ImportOptions(collection="raw", licence="CC BY-NC 4.0", subject="ada")
    project.imports.upload(find_files([takes / "walk.bvh"]).files, options)
    inputs = {"clips": CollectionInput(collection="raw"), "skeleton": ItemInput(item=target_skeleton(project).id)}
    marey.jobs.wait(project.submit(JobCreate(kind="retarget", inputs=inputs, into="out")).id, timeout_s=PATIENCE_S)
    (result,) = project.clips.list(collection="out")
    info = result.info()
    assert (info.licence, info.subject) == ("CC BY-NC 4.0", "ada")
    assert present(info.source).details["scale"] > 0


def test_a_large_file_arrives_whole(marey: Marey, tmp_path: Path) -> None:
    data = np.random.default_rng(1).bytes(70 << 20)
    (tmp_path / "large.bin").write_bytes(data)
    digest = marey.blobs.put_file(tmp_path / "large.bin")
    assert digest == f"sha256:{hashlib.sha256(data).hexdigest()}"
    assert marey.blobs.missing([digest]) == set()
    assert marey.blobs.fetch_to(digest, tmp_path / "back.bin").read_bytes() == data


def test_an_import_that_becomes_a_job_answers_like_one_that_does_not(
    project: ProjectHandle, marey: Marey, tmp_path: Path
) -> None:
    content = write_bvh(generate_gait(1.0, 0.0, 0.1))
    (tmp_path / "take.bvh").write_bytes(content)
    blob = marey.blobs.put_file(tmp_path / "take.bvh")
    files = tuple(ImportFile(name=f"{number:03d}/take.bvh", blob=blob) for number in range(80))
    first, again = project.imports.run(files), project.imports.run(files)
    assert [entry.name for entry in first] == [file.name for file in files]
    assert {entry.status for entry in first} == {"created"}
    assert {entry.status for entry in again} == {"unchanged"}
    assert [entry.item for entry in first] == [entry.item for entry in again]
    assert len({entry.skeleton for entry in first}) == 1
    assert project.clips.get(present(first[0].item)).path == "000/take"


def test_the_log_of_a_job_can_be_read_and_followed(
    project: ProjectHandle, marey: Marey, takes: Path, run: CommandLine
) -> None:
    (takes_file,) = find_files([takes / "broken.bvh"]).files
    blob = marey.blobs.put_file(takes_file.path)
    job = project.submit(JobCreate(kind="import", params={"files": [{"name": "broken.bvh", "blob": blob}]}))
    followed = b"".join(marey.jobs.log(job.id, follow=True))
    assert b"broken.bvh" in followed
    assert run("job", "log", job.id).stdout.encode() == followed


def test_logging_in_stores_a_token_for_its_owner_alone(marey: Marey, server: ServerProcess, tmp_path: Path) -> None:
    marey.users.create(UserCreate(name="grace", password="correct horse battery"))
    environment = {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}
    environment |= {"XDG_CONFIG_HOME": str(tmp_path), "HOME": str(tmp_path)}

    def command(*arguments: str, stdin: str = "") -> subprocess.CompletedProcess[str]:
        with mock.patch.dict(os.environ, environment, clear=True), contextlib.chdir(tmp_path):
            return run_here(list(arguments), stdin)

    with server.client() as other:
        token = other.sign_in(Login(name="grace", password="correct horse battery")).secret
    done = command("login", "--server", server.url, "--with-token", stdin=f"{token}\n")
    assert done.returncode == 0, done.stderr
    assert token not in done.stdout + done.stderr
    (stored,) = tmp_path.rglob("credentials.json")
    assert stored.stat().st_mode & 0o777 == 0o600
    assert json.loads(command("user", "show", "--json").stdout)["user"]["name"] == "grace"
    assert command("logout").returncode == 0
    assert command("user", "show", "--server", server.url).returncode == 1


def test_an_edited_mapping_of_the_clips_own_skeleton_is_gone_by(
    project: ProjectHandle, marey: Marey, takes: Path
) -> None:
    project.imports.upload(find_files([takes / "walk.bvh"]).files, ImportOptions(collection="raw"))
    studio = target_skeleton(project)

    def retargeted(into: str) -> ClipHandle:
        job = project.retarget([CollectionInput(collection="raw")], studio.id, into=into)
        marey.jobs.wait(job.id, timeout_s=PATIENCE_S)
        (clip,) = project.clips.list(collection=into)
        return clip

    before = retargeted("before")
    (source,) = [skeleton for skeleton in project.skeletons.list() if skeleton.id != studio.id]
    mapping = source.mapping()
    joints = {standard: joint for standard, joint in mapping.joints.items() if standard != "left_elbow"}
    source.put_mapping(SkeletonMapping(joints=joints, axes=mapping.axes))
    after = retargeted("after")
    assert present(before.info().source).details["mapped"] == present(after.info().source).details["mapped"] + 1
    assert "left_elbow" in present(after.info().source).details["missing"]
    used = {(edge.role, edge.revision) for edge in after.lineage().inputs}
    assert ("rigs", 2) in used


def test_a_project_says_what_it_holds_what_is_stale_and_takes_paths_and_revisions(
    project: ProjectHandle, marey: Marey, takes: Path, run: CommandLine
) -> None:
    name = project.name
    upload = ("upload", str(takes / "walk.bvh"), "--project", name, "--collection")
    run(*upload, "raw")
    (own,) = project.skeletons
    run(*upload, "again", "--skeleton", f"{name}/{own.path}")
    assert project.clips["again/walk"].item.summary["skeleton"] == own.id
    run("retarget", f"{name}/raw", "--to", f"{name}/{own.path}", "--into", "made")
    assert "nothing is stale among 4 items" in run("stale", name).stderr
    missing = run("stale", f"{name}/nowhere", status=1)
    assert "there is no folder 'nowhere'" in missing.stderr
    walk = project.clips["raw/walk"]
    walk.put_info(walk.info().model_copy(update={"comment": "changed"}))
    assert "made/raw/walk" in run("stale", f"{name}/made").stdout
    assert json.loads(run("stale", name, "--json").stdout)[0]["because"][0]["revision"] == 1
    by_item = [answer for clip in project.clips.list(sort="name") if (answer := clip.staleness()).stale]
    assert list(project.clips.outdated(page_size=1)) == by_item  # pages without a stale item are passed
    assert [list(project.clips.outdated(collection=folder)) for folder in ("raw", "made")] == [[], by_item]
    shown = run("ls", name, "-r", "--kind", "clip", "--columns", "kind,stale", "--sort=-stale").stdout
    lines = [line.split() for line in shown.splitlines() if "/walk" in line]
    assert lines == [["made/raw/walk", "clip", "stale"], ["again/walk", "clip"], ["raw/walk", "clip"]]
    assert run("ls", f"{name}/made/raw/walk", "--columns", "stale").stdout.split()[-1] == "stale"
    assert "raw/walk" not in run("ls", f"{name}/raw", "--stale").stdout
    assert "comment" not in run("show", f"{name}/raw/walk", "--revision", "1", "--part", "info").stdout
    run("download", f"{name}/raw/walk", "--revision", "1", "--format", "bvh", "-o", "out")
    held = run("df", name).stdout
    assert re.search(rf"{name} +4 +0\.\d+ MiB", held), held


def test_duplicate_skeletons_are_previewed_and_merged(project: ProjectHandle, takes: Path, run: CommandLine) -> None:
    project.imports.upload(find_files([takes]).files, ImportOptions(collection="raw"))
    (kept,) = project.skeletons
    hierarchy = kept.hierarchy().model_dump(mode="json", by_alias=True)
    hierarchy["joints"][0]["offset"][0] += 2.0
    twin = project.skeletons.create("twin", {"hierarchy": hierarchy}, collection="skeletons")
    walk = project.clips["raw/walk"]
    walk.put_part("motion", {**walk.part("motion"), "skeleton": {"item": twin.id, "revision": 1}})
    said = run("skeleton", "merge", project.name, "--dry-run").stderr
    assert said.startswith(f"skeletons/twin would be merged into {kept.path}; 1 clip")
    refused = run("skeleton", "merge", project.name, f"{project.name}/skeletons/twin", status=2).stderr
    assert "either a project or skeletons in it" in refused
    run("skeleton", "merge", f"{project.name}/skeletons/twin", "--keep", f"{project.name}/{kept.path}")
    assert project.clips["raw/walk"].item.summary["skeleton"] == kept.id
    assert project.merge_skeletons().rigs == ()


def test_a_body_that_was_hardly_recognised_is_refused_until_somebody_confirms_it(
    project: ProjectHandle, marey: Marey, takes: Path, run: CommandLine
) -> None:
    project.imports.upload(find_files([takes / "walk.bvh"]).files, ImportOptions(collection="raw"))
    studio = target_skeleton(project)
    (source,) = [skeleton for skeleton in project.skeletons.list() if skeleton.id != studio.id]
    source.put_mapping(source.mapping().model_copy(update={"confidence": 0.2}))
    sources = [CollectionInput(collection="raw")]
    with pytest.raises(errors.JobUnsuccessful, match="none of 1 clip can be retargeted") as doubtful:
        marey.jobs.wait(project.retarget(sources, studio.id, into="doubtful").id, timeout_s=PATIENCE_S)
    assert doubtful.value.job.failure.code == "nothing-done"
    place = f"{project.name}/{source.id}"
    assert "revision 3" in run("skeleton", "map", place, "--confirm").stderr
    known = source.mapping().joints["left_ankle"]
    assert "nothing changes" in run("skeleton", "map", place, f"left_ankle={known}").stderr
    assert "did you mean left_ankle" in run("skeleton", "map", place, f"leftankle={known}", status=2).stderr
    assert project.skeletons.get(source.id).item.revision == 3
    ended = marey.jobs.wait(project.retarget(sources, studio.id, into="confirmed").id, timeout_s=PATIENCE_S)
    assert present(ended.result)["clips"] == 1


def test_axes_that_a_mapping_lacks_are_stated_as_a_pair(project: ProjectHandle, run: CommandLine) -> None:
    studio = target_skeleton(project)
    mapping = studio.mapping()
    elbow = mapping.joints["left_elbow"]
    others = {joint: axes for joint, axes in mapping.axes.items() if joint != elbow}
    studio.put_mapping(mapping.model_copy(update={"axes": others}))
    place = f"{project.name}/{studio.id}"

    refused = run("skeleton", "axes", place, elbow, "--twist", "1,0,0", status=2).stderr
    assert "has no axes yet; give it both" in refused
    run("skeleton", "axes", place, elbow, "--twist", "1,0,0", "--swing", "0,1,0")
    run("skeleton", "axes", place, elbow, "--swing", "0,0,1")
    assert studio.mapping().axes[elbow].twist == (1.0, 0.0, 0.0)
    assert studio.mapping().axes[elbow].swing == (0.0, 0.0, 1.0)
    assert studio.mapping().method == "manual"

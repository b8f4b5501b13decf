"""The function of the job kind `script`, with a project in memory, real Git repositories and hostile scripts."""

from __future__ import annotations

import json
import mmap
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from tests.support.project_in_memory import ProjectInMemory, add_clip
from typer.testing import CliRunner

from marey_client.cli.app import app
from marey_motion import read_motion
from marey_motion.gait import generate_gait
from marey_schemas.consents import CONSENT_EXPIRED
from marey_schemas.kinds import Kind
from marey_schemas.queue.own_pods import IMAGE_VARIABLE
from marey_schemas.queue.scripts import REPOSITORIES_VARIABLE, ScriptDeclaration, ScriptParams
from marey_worker.context import JobRefused
from marey_worker.kinds import script
from marey_worker.scratch import remove_folder
from marey_worker.scripts import guard
from marey_worker.scripts.checkout import FetchFailed
from marey_worker.scripts.confinement import landlock_version
from marey_worker.scripts.fields import read_fields
from marey_worker.scripts.files import OUTPUTS, collect
from marey_worker.scripts.guard import (
    LOG_BYTES,
    THREADS_PER_PROCESS,
    CommandEnd,
    GuardedCommand,
    fault_of_files,
    nameless_bytes,
)

pytestmark = pytest.mark.skipif(landlock_version() == 0, reason="scripts need Linux with Landlock")

WRITE_FIELDS = 'import json, sys\njson.dump({"answer": 42, "name": "x", "good": True}, open(sys.argv[-1], "w"))\n'
LIMITS = {"seconds": 60, "memory_mb": 256, "written_mb": 8, "processes": 16}


class Repository:
    """Git repository of one test, and the runs of its scripts."""

    def __init__(self, folder: Path, project: ProjectInMemory) -> None:
        self.folder = folder
        self.project = project
        self.git("init", "-q", "-b", "main")

    def git(self, *words: str) -> str:
        who = ["-c", "user.name=tester", "-c", "user.email=tester@example.org"]
        command = ["git", "-C", str(self.folder), *who, *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    def commit(self, **files: str) -> str:
        for name, text in files.items():
            (self.folder / f"{name}.py").write_text(text)
        self.git("add", ".")
        self.git("commit", "-q", "-m", "files")
        return self.git("rev-parse", "HEAD")

    def declare(self, commit: str, **changes: Any) -> ScriptDeclaration:
        declared: dict[str, Any] = {
            "repository": f"file://{self.folder}", "commit": commit, "argv": ["python", "run.py", "{output:fields}"],
            "outputs": {"fields": {"kind": "fields"}}, "limits": LIMITS,
        }  # fmt: skip
        return ScriptDeclaration.model_validate(declared | changes)

    def run(self, text: str, values: dict[str, Any] | None = None, **changes: Any) -> dict[str, Any]:
        declared = self.declare(self.commit(run=text), **changes)
        return script.run(self.project, ScriptParams(script="test", values=values or {}, declaration=declared))


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Repository:
    for name in ("scratch", "repository", "cache"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(REPOSITORIES_VARIABLE, json.dumps([f"file://{tmp_path}/"]))
    monkeypatch.setenv("MAREY_TOKEN", "a-secret-token")
    project = ProjectInMemory(tmp_path / "scratch")
    project.seed = 7
    return Repository(tmp_path / "repository", project)


def refusal(repository: Repository, text: str, **changes: Any) -> JobRefused:
    before = running_below()
    with pytest.raises(JobRefused) as refused:
        repository.run(text, **changes)
    assert running_below() <= before
    return refused.value


def running_below() -> set[psutil.Process]:
    """Return the running descendants of this process, such as servers of other tests."""
    return {one for one in psutil.Process().children(recursive=True) if one.status() != psutil.STATUS_ZOMBIE}


def test_a_script_reads_clips_and_its_clips_and_fields_and_files_are_stored(repository: Repository) -> None:
    add_clip(repository.project, "walk", generate_gait(1.4, 0.0, 1.0))
    add_clip(repository.project, "stroll", generate_gait(1.0, 0.0, 1.0))
    copy = (
        "import json, os, shutil, sys\n"
        "clips, factor, copy, blob, fields = sys.argv[1:]\n"
        "names = sorted(os.listdir(clips))\n"
        "listed = json.load(open('inputs.json'))['clips']\n"
        "shutil.copyfile(os.path.join(clips, names[0]), copy)\n"
        "open(blob, 'wb').write(b'bytes')\n"
        "seed, secret = os.environ['MAREY_SEED'], 'MAREY_TOKEN' in os.environ\n"
        "json.dump({'count': len(names), 'factor': float(factor), 'first': listed[0]['name'], 'seed': int(seed),"
        " 'secret': secret}, open(fields, 'w'))\n"
    )
    result = repository.run(
        copy,
        {"factor": 0.5},
        argv=["python", "run.py", "{input:clips}", "{parameter:factor}", "{output:copy}", "{output:blob}",
              "{output:fields}"],
        parameters={"factor": {"type": "number", "default": 1.0}},
        inputs={"clips": {"format": "bvh", "many": True}},
        outputs={"copy": {"kind": "clip", "format": "bvh"}, "blob": {"kind": "file"}, "fields": {"kind": "fields"}},
    )  # fmt: skip
    assert result["fields"] == {"count": 2, "factor": 0.5, "first": "walk", "seed": 7, "secret": False}
    assert repository.project.blobs[result["files"]["blob"]["blob"]] == b"bytes"
    (clip,) = [one for one in repository.project.staged if one.kind is Kind.CLIP]
    given = repository.project.parts["clip_walk", 1, "motion"]["poses"]
    assert clip.item_name == "test-copy"
    poses = np.asarray(clip.parts["motion"]["poses"])
    assert np.abs(poses[:, :3] - given[:, :3]).max() < 1e-4, "metres; the file has centimetres"


def test_a_captured_clip_survives_a_script_that_copies_it(repository: Repository, mocap: Path) -> None:
    file = mocap / "bandai-namco-1" / "dataset-1_dash_normal_001.bvh"
    captured = read_motion(file.read_bytes(), file.name).clip
    assert captured is not None
    add_clip(repository.project, "dash", captured)
    repository.run(
        "import shutil, sys\nshutil.copyfile(*sys.argv[1:])\n",
        argv=["python", "run.py", "{input:clips}", "{output:copy}"],
        inputs={"clips": {"format": "bvh"}},
        outputs={"copy": {"kind": "clip", "format": "bvh"}},
    )
    (copy,) = [one for one in repository.project.staged if one.kind is Kind.CLIP]
    given = repository.project.parts["clip_dash", 1, "motion"]["poses"]
    poses = np.asarray(copy.parts["motion"]["poses"])
    assert poses.shape == given.shape
    assert np.abs(poses[:, :3] - given[:, :3]).max() < 1e-4


def test_a_failing_script_fails_the_job_with_its_status_and_last_lines(repository: Repository) -> None:
    error = refusal(repository, "import sys\nprint('one')\nprint('the reason', file=sys.stderr)\nsys.exit(3)")
    assert error.code == "script-failed"
    assert "exit status 3" in error.detail
    assert error.detail.endswith("the reason")


HOSTILE = {
    "fork bomb": ("import os\nwhile True:\n try: os.fork()\n except OSError: pass", "more than 16 processes"),
    "endless output": ("while True: print('x' * 1000)", f"printed more than {LOG_BYTES >> 20} MiB"),
    "many files": (
        "n = 0\nwhile True:\n n += 1\n open(f'file{n}', 'wb').write(b'x' * 1000000)",
        "its files took more than 8 MiB",
    ),
    "files without a name": (
        "import os, time\nopened = []\nfor _ in range(4):\n opened.append(open('x', 'wb', 0))\n"
        " opened[-1].write(bytes(4_000_000))\n os.unlink('x')\ntime.sleep(30)",
        "its files took more than 8 MiB",
    ),
    "files in memory": (
        "import os, time\nfor _ in range(4): os.write(os.memfd_create('x'), bytes(4_000_000))\ntime.sleep(30)",
        "its files took more than 8 MiB",
    ),
    "deep folders": (
        "import os, time\nfor _ in range(1500): os.mkdir('d'); os.chdir('d')\ntime.sleep(30)",
        "nested deeper than",
    ),
    "much memory": (
        "import os\nfor _ in range(4):\n if os.fork() == 0: break\nx = bytearray(b'x') * 200_000_000\n"
        "import time; time.sleep(30)",
        "used more than 256 MiB",
    ),
}


BOMB = (  # it stops by itself
    "import os, time\nmade = 0\nwhile made < 400:\n try:\n  if os.fork() == 0: time.sleep(60); os._exit(0)\n"
    " except OSError: break\n made += 1\nos.write(1, b'%d' % made)\ntime.sleep(60)"
)
LATE_GUARD = """
from marey_worker.scripts import guard
from marey_worker.scripts.namespaces import Separation
guard.LOOK_EVERY_S = 20.0  # as on a machine that has no time for it, until the bomb has printed a number
if not {namespaces}:
    guard.separate = lambda folder, network, user: Separation(False, user)
guard.main()
"""


@pytest.mark.parametrize("namespaces", [True, False])
def test_the_kernel_stops_a_fork_bomb_before_the_guard_counts(tmp_path: Path, *, namespaces: bool) -> None:
    """Without namespaces, the kernel limits only a user without other processes, which only root can choose."""
    order = GuardedCommand((sys.executable, "-c", BOMB), str(tmp_path), {}, 60, 1024, 8, 16, network=False)
    read_end, write_end = os.pipe()
    with os.fdopen(read_end) as result:
        command = [sys.executable, "-c", LATE_GUARD.format(namespaces=namespaces), str(write_end)]
        subprocess.run(command, input=json.dumps(asdict(order)), text=True, pass_fds=[write_end], check=True)
        os.close(write_end)
        end = CommandEnd(**json.loads(result.read()))
    assert (end.isolated, end.bounded) == (namespaces, namespaces or os.geteuid() == 0)
    assert end.stopped == "it had more than 16 processes at the same time"
    assert not end.bounded or 16 < int(end.tail) < 16 * THREADS_PER_PROCESS


def test_doctor_says_how_far_a_machine_confines_scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(REPOSITORIES_VARIABLE, "[]")
    command = ["doctor", "--no-local", "--no-remote"]
    told = CliRunner().invoke(app, command)
    assert (told.exit_code, told.stdout) == (0, "ok       scripts: confined, with all limits\n")
    end = CommandEnd(0, None, "", isolated=True, bounded=False)
    monkeypatch.setattr(script, "_run_guarded", lambda order: end)
    assert f"warning  scripts: {script.NOT_BOUNDED}" in CliRunner().invoke(app, command).stdout
    monkeypatch.setattr(script, "landlock_version", lambda: 0)
    assert CliRunner().invoke(app, command).exit_code == 1


@pytest.mark.every_nth(3)
@pytest.mark.parametrize("what", HOSTILE)
def test_a_script_that_exceeds_a_limit_is_killed_with_all_its_processes(repository: Repository, what: str) -> None:
    text, reason = HOSTILE[what]
    error = refusal(repository, text)
    assert (error.code, reason in error.detail) == ("script-limit", True), error.detail
    remove_folder(repository.project.scratch)


def test_folders_count_as_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(3):
        (tmp_path / str(number)).mkdir()
    assert fault_of_files(tmp_path, 0, 1) is None
    monkeypatch.setattr(guard, "MOST_FILES", 2)
    assert "more than 2" in (fault_of_files(tmp_path, 0, 1) or "")


def test_folders_without_rights_and_links_are_removed(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.mkdir(mode=0o755)
    (kept / "file").touch()
    scratch = tmp_path / "scratch"
    (scratch / "a" / "b").mkdir(parents=True)
    (scratch / "a" / "link").symlink_to(kept)
    (scratch / "a" / "b").chmod(0)
    (scratch / "a").chmod(0)
    remove_folder(scratch)
    assert not scratch.exists()
    assert (kept / "file").exists()
    remove_folder(scratch)


def test_a_script_that_sleeps_past_its_limit_is_killed(repository: Repository) -> None:
    text = "import os, time\nos.fork()\nos.setsid() if os.fork() == 0 else None\ntime.sleep(60)"
    error = refusal(repository, text, limits=LIMITS | {"seconds": 2})
    assert "longer than its limit of 2 s" in error.detail


def test_processes_that_outlive_the_command_are_killed(repository: Repository) -> None:
    daemon = "import os, time\nif os.fork() == 0:\n os.setsid()\n os.close(1); os.close(2)\n time.sleep(600)\n"
    before = running_below()
    assert repository.run(daemon + WRITE_FIELDS)["fields"]["answer"] == 42
    assert running_below() <= before


DENIED = {
    "write outside": "open('{outside}/evil', 'w')",
    "read outside": "open('{outside}/secret').read()",
    "list outside": "__import__('os').listdir('{outside}')",
    "environment of others": "open('/proc/{parent}/environ', 'rb').read()",
    # Beyond the limit of one file, without using up the limit of all files. 65: for writing, created if missing.
    "one huge file": "__import__('os').pwrite(__import__('os').open('huge', 65), b'x', 9_000_000)",
    "one huge allocation": "bytearray(1_000_000_000)",
    "network": "__import__('socket').create_connection(('127.0.0.1', {port}), 5)",
    "Unix socket": "__import__('socket').socket(1).connect('{outside}/socket')",
    "mode": "__import__('os').chmod('{outside}/secret', 0o777)",
    "times": "__import__('os').utime('{outside}/secret')",
    "user": "__import__('os').setuid(1001)",  # root, as the script sees it
    "signal": "__import__('os').kill({parent}, 0)",
}


def test_a_script_cannot_reach_outside(repository: Repository, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret")
    with socket.create_server(("127.0.0.1", 0)) as listening, socket.socket(socket.AF_UNIX) as unix:
        unix.bind(str(tmp_path / "socket"))
        unix.listen()
        port = listening.getsockname()[1]
        tries = {name: text.format(outside=tmp_path, parent=os.getpid(), port=port) for name, text in DENIED.items()}
        text = (
            "import json, sys\n"
            "def succeeds(code):\n"
            "    try:\n        eval(code)\n    except BaseException:\n        return False\n    return True\n"
            f"found = {{name.replace(' ', '_'): succeeds(code) for name, code in {tries!r}.items()}}\n"
            "found['inside'] = succeeds(\"open('inside', 'w'), __import__('os').chmod('inside', 0o755)\")\n"
            "found['pair'] = succeeds(\"__import__('socket').socketpair()\")\n"
            "json.dump(found, open(sys.argv[-1], 'w'))\n"
        )
        fields = repository.run(text)["fields"]
    assert fields == {name.replace(" ", "_"): False for name in DENIED} | {"inside": True, "pair": True}
    assert not (tmp_path / "evil").exists()


def link_folder(file: Path) -> None:
    file.parent.rmdir()
    file.parent.symlink_to(file.parents[2] / "repository")


def hard_link(file: Path) -> None:
    (file.parent / "other").touch()
    file.hardlink_to(file.parent / "other")


UNSAFE: dict[str, tuple[Callable[[Path], object], str]] = {
    "linked folder": (link_folder, "unsafe-output"),
    "pipe": (os.mkfifo, "unsafe-output"),
    "hard link": (hard_link, "unsafe-output"),
    "folder": (Path.mkdir, "unsafe-output"),
    "nothing": (lambda file: None, "no-output"),
    "too large": (lambda file: file.write_text("x" * 2000), "output-too-large"),
    "no JSON": (lambda file: file.write_text("{"), "bad-fields"),
    "not a number": (lambda file: file.write_text('{"a": NaN}'), "bad-fields"),
    "long integer": (lambda file: file.write_text('{"a": 1' + "0" * 30 + "}"), "bad-fields"),
    "nested": (lambda file: file.write_text('{"a": [1]}'), "bad-fields"),
    "bad name": (lambda file: file.write_text('{"a.b": 1}'), "bad-fields"),
    "deep": (lambda file: file.write_text("[" * 900), "bad-fields"),
}


@pytest.mark.parametrize("what", UNSAFE)
def test_an_output_that_is_not_as_declared_fails_the_job(repository: Repository, what: str, tmp_path: Path) -> None:
    write, code = UNSAFE[what]
    declared = repository.declare("c" * 40, outputs={"fields": {"kind": "fields", "max_bytes": 1000}})
    run = tmp_path / "run"
    (run / OUTPUTS).mkdir(parents=True)
    write(run / OUTPUTS / "fields.json")
    with pytest.raises(JobRefused) as refused:
        read_fields("fields", declared.outputs["fields"], collect(declared, run, tmp_path / "collected")["fields"])
    assert refused.value.code == code, refused.value.detail


def test_a_folder_of_the_run_that_cannot_be_opened_fails_the_job(repository: Repository, tmp_path: Path) -> None:
    declared = repository.declare("c" * 40, outputs={"fields": {"kind": "fields"}})
    run = tmp_path / "run"
    run.write_text("a file in place of the folder")
    with pytest.raises(JobRefused, match="unreadable") as refused:
        collect(declared, run, tmp_path / "collected")
    assert refused.value.code == "unsafe-output"


def test_a_link_as_output_fails_the_job(repository: Repository) -> None:
    assert refusal(repository, "import os, sys; os.symlink('/etc/passwd', sys.argv[-1])").code == "unsafe-output"


def test_a_clip_that_cannot_be_read_fails_the_job(repository: Repository) -> None:
    argv = ["python", "run.py", "{output:clip}"]
    outputs = {"clip": {"kind": "clip", "format": "bvh"}}
    error = refusal(repository, "import sys; open(sys.argv[-1], 'w').write('HIER')", argv=argv, outputs=outputs)
    assert error.code == "bad-clip"


def test_a_script_with_an_image_runs_only_in_this_image(
    repository: Repository, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = f"registry.example.org/torch@sha256:{'a' * 64}"
    assert refusal(repository, WRITE_FIELDS, image=image).code == "wrong-image"
    monkeypatch.setenv(IMAGE_VARIABLE, image)
    assert repository.run(WRITE_FIELDS + "# again\n", image=image)["fields"]


def test_only_commits_of_branches_and_tags_of_allowed_repositories_run(
    repository: Repository, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = repository.commit(run=WRITE_FIELDS)
    repository.git("commit", "-q", "--amend", "-m", "other")  # `first` is in no branch any more, but still stored
    params = ScriptParams(script="test", declaration=repository.declare(first))
    with pytest.raises(JobRefused, match=r"no branch or tag of .* contains the commit"):
        script.run(repository.project, params)
    monkeypatch.setenv(REPOSITORIES_VARIABLE, '["https://git.example.org/"]')
    error = refusal(repository, WRITE_FIELDS + "# again\n")
    assert error.code == "repository-not-allowed"


def test_a_repository_that_cannot_be_read_is_tried_again(repository: Repository) -> None:
    commit = repository.commit(run=WRITE_FIELDS)
    declared = repository.declare(commit, repository=f"file://{repository.folder.parent}/missing")
    with pytest.raises(FetchFailed, match=r"git fetch of .*missing failed"):
        script.run(repository.project, ScriptParams(script="test", declaration=declared))


def test_files_that_a_killed_git_has_left_in_the_cache_do_not_stop_later_runs(
    repository: Repository, tmp_path: Path
) -> None:
    repository.run(WRITE_FIELDS)
    (cached,) = (tmp_path / "cache").rglob("*.git")
    left = [cached / "config.lock", cached / "refs" / "heads" / "main.lock", cached / "objects" / "pack" / "tmp_pack_x"]
    for file in left:
        file.touch()
    repository.project.scratch = tmp_path / "second"
    repository.project.scratch.mkdir()
    assert repository.run(WRITE_FIELDS + "# again\n")["fields"]["answer"] == 42
    assert not [file for file in left if file.exists()]


def test_hooks_and_links_of_the_commit_do_nothing(repository: Repository) -> None:
    (repository.folder / "leading_out").symlink_to("/etc/passwd")
    assert refusal(repository, WRITE_FIELDS).code == "unsafe-commit"


def test_a_clip_whose_consent_has_ended_is_not_given_to_a_script(repository: Repository) -> None:
    add_clip(repository.project, "walk", generate_gait(1.4, 0.0, 1.0))
    (walk,) = repository.project.inputs["clips"]
    repository.project.inputs["clips"] = (walk.model_copy(update={"consent_ended": "2026-01-31"}),)
    argv = ["python", "run.py", "{input:clips}", "{output:fields}"]
    error = refusal(repository, WRITE_FIELDS, argv=argv, inputs={"clips": {"format": "bvh"}})
    assert error.code == CONSENT_EXPIRED


def test_a_program_of_the_commit_runs_without_a_shell(repository: Repository) -> None:
    program = repository.folder / "tool"
    program.write_text(f"#!{sys.executable}\n{WRITE_FIELDS}")
    program.chmod(0o755)
    argv = ["./tool", "$(touch evil); {x}", "{parameter:text}", "{output:fields}"]
    values = {"text": "a b; rm -rf ."}
    result = repository.run("", values, argv=argv, parameters={"text": {"type": "text"}})
    assert result["fields"] == {"answer": 42, "name": "x", "good": True}
    assert result["values"] == values


def test_an_open_file_counts_as_soon_as_it_has_no_name(tmp_path: Path) -> None:
    this, size = [psutil.Process()], 8 * 2**20
    with (tmp_path / "scratch").open("wb") as file:
        file.write(bytes(size))
        file.flush()
        named = nameless_bytes(this)
        (tmp_path / "scratch").unlink()
        assert size <= nameless_bytes(this) - named < 2 * size


@pytest.mark.parametrize("by_root", [True, False])
def test_a_memory_file_counts_while_it_is_mapped_and_its_descriptor_is_closed(
    monkeypatch: pytest.MonkeyPatch, *, by_root: bool
) -> None:
    def refuse(path: Any, **options: Any) -> os.stat_result:
        if not by_root and "map_files" in str(path):
            raise PermissionError(path)
        return real(path, **options)

    real = os.stat
    monkeypatch.setattr(os, "stat", refuse)
    this, size = [psutil.Process()], 8 * 2**20
    before = nameless_bytes(this)
    file = os.memfd_create("kept")
    os.write(file, bytes(size))
    kept = mmap.mmap(file, size)
    os.close(file)
    kept.madvise(mmap.MADV_DONTNEED)  # so that the pages do not count as memory of the process
    assert nameless_bytes(this) - before >= size
    kept.close()
    assert nameless_bytes(this) - before < size

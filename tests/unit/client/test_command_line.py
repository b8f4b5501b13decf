"""Command line: everything that can be tested without a server."""

import contextlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any, cast
from unittest import mock

import httpx
import pytest
import typer
from tests.support.command_line import run_here
from tests.support.scripted_server import ScriptedServer, problem

from marey_client.cli import projects, skeletons, with_global_options_first
from marey_client.cli.access import tokens
from marey_client.cli.addresses import Address, folder_or_item, require_item
from marey_client.cli.app import OTHER_NAMES, app, with_one_command
from marey_client.cli.clip_jobs import _print_aligned, _print_warnings, print_labelled
from marey_client.cli.datasets import combining, versions
from marey_client.cli.datasets.combining import resolutions_of
from marey_client.cli.files import downloading, uploading
from marey_client.cli.files.listing import _folders_in, _items_in, _stale_reasons
from marey_client.cli.files.uploading import _print_entries
from marey_client.cli.queue.jobs import _done
from marey_client.cli.queue.pipelines import _print_shortfalls
from marey_client.cli.terminal.failures import Refused, WrongUsage, sentence
from marey_client.cli.terminal.following import clips_at, follow, print_ended
from marey_client.cli.terminal.invocation import connect
from marey_client.cli.terminal.output import ago, print_table
from marey_client.credentials import Credential, Logins, read_logins, store_login, write_private
from marey_client.errors import BadCredentialFile, Forbidden, Invalid, NotFound, Unauthenticated, Unreachable
from marey_client.handles.pipelines import PipelineRun
from marey_client.marey import Marey
from marey_schemas.documents.skeletons import SkeletonMapping
from marey_schemas.imports import ImportEntry
from marey_schemas.items import LineageEdge, Staleness
from marey_schemas.kinds import Kind
from marey_schemas.queue.jobs import CollectionInput, Job, JobState, Progress

Done = CompletedProcess[str]


def marey(*arguments: str, env: dict[str, str]) -> Done:
    """Run a command in a process of its own, and return its result."""
    command = [sys.executable, "-c", "from marey_client.cli import main; main()", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, **env})


def marey_here(arguments: Iterable[str], env: dict[str, str], cwd: Path | None = None, stdin: str = "") -> Done:
    """Run a command in this process, because starting a process takes long; return its result."""
    with mock.patch.dict(os.environ, env), contextlib.chdir(cwd or Path.cwd()):
        return run_here(list(arguments), stdin)


NO_OPTIONS = typer.Context(typer.main.get_command(app))
AT = "2026-01-01T00:00:00Z"
PROJECT = {
    "id": "project_1", "name": "lab", "visibility": "private", "created_at": AT, "updated_at": AT, "rev": 1,
}  # fmt: skip


@pytest.fixture
def nowhere(tmp_path: Path) -> dict[str, str]:
    """Environment of a user without stored logins, with the address of a server that does not exist."""
    return {
        "XDG_CONFIG_HOME": str(tmp_path), "MAREY_DATA": str(tmp_path), "MAREY_URL": "http://127.0.0.1:9",
        "MAREY_TOKEN": "marey_very_secret",
    }  # fmt: skip


def a_job(**fields: Any) -> Job:
    """Return a job that has only these fields."""
    return Job.model_construct(**fields)


def test_help_loads_nothing_heavy() -> None:
    probe = (
        "import sys; from marey_client.cli.app import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'httpx', 'pydantic', 'rich', 'bson', 'marey_server', 'marey_worker', 'marey_motion'}\n"
        "print(sorted(heavy & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True)
    assert done.stderr.strip() == "[]"
    for command in (
        "serve",
        "worker",
        "demo",
        "db",
        "upload",
        "download",
        "retarget",
        "evaluate",
        "report",
        "skeleton",
        "job",
        "why",
    ):
        assert command in done.stdout


def test_each_command_is_built_without_the_others() -> None:
    every_command: Any = typer.main.get_command(app)
    for name, command in every_command.commands.items():
        alone: Any = typer.main.get_command(with_one_command(name))
        assert list(alone.commands) == [name]
        assert alone.commands[name].help == command.help
    assert with_one_command("no-such-command") is app
    assert with_one_command(None) is app


def test_every_command_explains_itself() -> None:
    from typer.main import get_command

    from marey_client.cli.app import app

    def walk(command: Any, path: list[str]) -> None:
        assert command.help, path
        for name, child in getattr(command, "commands", {}).items():
            walk(child, [*path, name])

    walk(get_command(app), ["marey"])


@pytest.mark.parametrize("interrupt", ["raise KeyboardInterrupt", "type('Class', (), {'attribute': Impatience()})"])
def test_who_interrupts_while_modules_load_sees_nothing_and_gets_130(interrupt: str) -> None:
    probe = (
        "import sys\n"
        "class Impatience:\n"
        "    def __set_name__(self, owner, name): raise KeyboardInterrupt\n"
        "    def find_spec(self, name, path, target=None):\n"
        f"        if name == 'typer': {interrupt}\n"
        "sys.meta_path.insert(0, Impatience())\n"
        "from marey_client.cli import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize("arguments", [["edit", "commands"], ["--help"]])
def test_a_reader_who_goes_away_is_no_news(arguments: list[str], nowhere: dict[str, str]) -> None:
    command = [sys.executable, "-c", "from marey_client.cli import main; main()", *arguments]
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, env={**os.environ, **nowhere})
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (1, "")


@pytest.mark.parametrize("arguments", [["nonsense"], ["ls", "--nonsense"], ["upload"], ["ls", "/"], ["job", "ls"]])
def test_wrong_usage_exits_with_2(arguments: list[str], nowhere: dict[str, str], tmp_path: Path) -> None:
    done = marey_here(arguments, nowhere, tmp_path)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


GIVEN = {
    "binary.json": b"\xff\xfe\x00",
    "source.json": b'[{"source": "other/x"}]',
    "search.json": b'{"steps": [{}], "constraints": 5}',
    "half.json": b'{"steps": {"a": {"kind": "tree", "params": {"x": "\\ud800"}}}}',
}
BUILD = ("build-model", "lab/walks", "--name", "w")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["pipeline", "binary.json", "--project", "lab"], "binary.json is not text in UTF-8"),
        (["pipeline", "nowhere.json", "--project", "lab"], "nowhere.json cannot be read: No such file or directory"),
        (["pipeline", "half.json", "--project", "lab"], "/steps/a/params/x: a string contains half of a surrogate"),
        (["edit", "apply", "lab/a", "--into", "x", "--file", "binary.json"], "binary.json is not text in UTF-8"),
        (
            ["edit", "apply", "lab/a", "--into", "x", "--file", "source.json"],
            "source clip other/x must be in the project",
        ),
        (["search", "lab/m", "--request", "search.json"], "constraints: the value must be a list"),
        ([*BUILD, "--set", "align.window=5", "--set", "align.window.x=2"], "conflicts with --set align.window=5"),
        ([*BUILD, "--set", "annotate.proposal=steps", "--propose", "steps"], "--propose steps conflicts with --set"),
        (["evaluate", "lab/walks", "--speeds", "1:inf:1"], "'1:inf:1': all values must be finite"),
        (["annotation", "add", "lab/a", "l", "0:" + "9" * 5000], "write label=first:end, as in step_left=120:180"),
        (["ls", "lab", "--server", "http://["], "'http://[' is not the address of a server; write it like http://"),
        (["ls", "lab", "--server", "http://127.0.0.1:99999"], "99999' is not the address of a server"),
        (["ls", "lab", "--server", "nowhere"], "'nowhere' is not the address of a server"),
        (["job", "show", os.fsdecode(b"\xff")], "is not text in UTF-8"),
    ],
)
def test_what_makes_no_sense_is_told_in_one_line_with_exit_status_2(
    arguments: list[str], told: str, nowhere: dict[str, str], tmp_path: Path
) -> None:
    for name, data in GIVEN.items():
        (tmp_path / name).write_bytes(data)
    done = marey_here(arguments, nowhere, tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert done.stderr.startswith("marey: ")
    assert told in done.stderr


def test_text_that_an_output_cannot_hold_is_escaped(nowhere: dict[str, str]) -> None:
    done = marey("edit", "commands", "é", env={**nowhere, "PYTHONIOENCODING": "ascii"})
    assert (done.returncode, done.stderr.startswith(r"marey: there is no command '\xe9'")) == (2, True)


def test_a_name_the_server_would_refuse_is_refused_before_it_is_sent(nowhere: dict[str, str]) -> None:
    done = marey_here(["project", "create", "Not A Name"], nowhere)
    assert done.returncode == 2
    assert done.stderr.startswith("marey: name: ")


def test_a_server_that_is_not_there_is_one_line_and_exit_status_1(nowhere: dict[str, str]) -> None:
    done = marey_here(["project", "ls"], nowhere)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("marey: http://127.0.0.1:9 does not answer")
    assert "marey_very_secret" not in done.stderr


def test_with_v_the_whole_story_is_told_without_the_token(nowhere: dict[str, str]) -> None:
    done = marey_here(["project", "ls", "-v"], nowhere)
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert "marey_very_secret" not in done.stderr


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["ls", "lab", "-v"], ["-v", "ls", "lab"]),
        (["ls", "--server", "http://x", "lab"], ["--server", "http://x", "ls", "lab"]),
        (["ls", "--token-file=t", "lab"], ["--token-file=t", "ls", "lab"]),
        (["show", "--", "-v"], ["show", "--", "-v"]),
        (["ls", "--server"], ["--server", "ls"]),
    ],
)
def test_options_of_marey_itself_may_stand_anywhere(given: list[str], expected: list[str]) -> None:
    assert with_global_options_first(given) == expected


def test_addresses_have_a_project_a_path_and_perhaps_an_id() -> None:
    address = Address.parse("lab/raw/walk")
    assert (address.project, address.path, address.has_id) == ("lab", "raw/walk", False)
    assert Address.parse("lab/clip_01m7ysc032mjg6sbhcx9q58xq7").has_id
    assert str(Address.parse("lab/")) == "lab"
    with pytest.raises(WrongUsage):
        Address.parse("/")


def test_a_final_slash_of_an_address_means_the_folder_even_if_a_clip_has_its_name(script: ScriptedServer) -> None:
    marey, folder = script.marey(), Address.parse("lab/raw/walks/")
    assert folder == Address.within("lab", "raw/walks/") == Address("lab", "raw/walks", is_folder=True)
    assert clips_at(marey, folder) == CollectionInput(collection="raw/walks")
    assert not script.requests

    def no_folder(request: httpx.Request) -> httpx.Response:
        assert request.url.path.endswith("/collections")
        return httpx.Response(200, content=b'{"items": [], "next_cursor": null}')

    script.answers = [no_folder, no_folder]
    with pytest.raises(WrongUsage, match="there is no folder at lab/raw/walks"):
        require_item(marey, folder, [Kind.CLIP])


def test_a_format_that_cannot_be_written_is_refused_before_anything_is_asked(nowhere: dict[str, str]) -> None:
    done = marey_here(["download", "lab/raw", "--format", "gltf"], nowhere)
    assert done.returncode == 2
    assert "the formats are original, bvh, npz" in done.stderr


def test_a_folder_is_shown_without_reading_those_below_it(script: ScriptedServer) -> None:
    def empty(request: httpx.Request) -> httpx.Response:
        return httpx.Response(200, content=b'{"items": [], "next_cursor": null}')

    script.answers = [empty] * len(Kind)
    _items_in(script.marey(), Address("lab", "raw"), recursive=False, kinds=None, tag=None)
    assert {request.url.params["directly_in"] for request in script.requests} == {"raw"}
    assert not any("collection" in request.url.params for request in script.requests)


def test_each_folder_directly_in_a_folder_is_listed_once(script: ScriptedServer) -> None:
    below = ("raw/walks/slow", "raw/walks", "raw/runs/fast")
    listed = [{"id": path, "path": path, "created_at": AT, "updated_at": AT, "rev": 1} for path in below]
    script.answers = [httpx.Response(200, json={"items": listed, "next_cursor": None})] * 2
    assert _folders_in(script.marey(), Address("lab", "raw")) == ["runs", "walks"]
    assert _folders_in(script.marey(), Address("lab", "")) == ["raw"]


@pytest.mark.parametrize(("token", "hinted"), [(None, True), ("marey_secret", False)])
def test_what_is_hidden_from_a_request_without_a_token_hints_at_that(
    script: ScriptedServer, token: str | None, hinted: bool
) -> None:
    script.answers = [problem(404, "no-project")]
    with (
        Marey("http://server.test", token, http=httpx.MockTransport(script)) as anyone,
        pytest.raises(NotFound) as raised,
    ):
        anyone.project("lab").read()
    assert ("marey login" in sentence(raised.value)) is hinted


@pytest.mark.parametrize(("token", "hinted"), [(None, True), ("marey_secret", False)])
def test_an_empty_list_of_projects_without_a_token_hints_at_that(
    script: ScriptedServer,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    token: str | None,
    hinted: bool,
) -> None:
    monkeypatch.setattr(projects, "connect", lambda context: answering(script, token))
    script.answers = [httpx.Response(200, content=b'{"items": [], "next_cursor": null}')]
    projects.list_projects(NO_OPTIONS)
    assert ("marey login" in capsys.readouterr().err) is hinted


@pytest.mark.parametrize(
    "find",
    [
        lambda marey: require_item(marey, Address("lab", "raw"), [Kind.CLIP]),
        lambda marey: folder_or_item(marey, "lab/raw", "clip"),
    ],
)
def test_who_asks_for_an_item_at_a_folder_is_told_that_it_is_one(
    script: ScriptedServer, find: Callable[[Marey], Any]
) -> None:
    folder = {
        "id": "collection_01m7ysc032mjg6sbhcx9q58xq7", "path": "raw", "rev": 1,
        "created_at": "2026-01-01T00:00:00Z", "updated_at": "2026-01-01T00:00:00Z",
    }  # fmt: skip

    def page(*members: Any) -> httpx.Response:
        return httpx.Response(200, content=json.dumps({"items": members, "next_cursor": None}))

    script.answers = [page(), page(folder)]
    with pytest.raises(WrongUsage, match=r"^lab/raw is a folder; `marey ls lab/raw` lists it$"):
        find(script.marey())
    script.answers = [page()] * 20
    with pytest.raises(WrongUsage, match=r"^there is .* at lab/raw; `marey ls lab` lists the project$"):
        find(script.marey())


@pytest.mark.parametrize(
    ("fields", "shown"),
    [
        ({"state": JobState.SUCCEEDED, "progress": Progress(done=185, total=302)}, "302/302"),
        ({"state": JobState.SUCCEEDED, "progress": Progress(done=185)}, ""),
        ({"state": JobState.RUNNING, "progress": Progress(done=185, total=302)}, "185/302"),
        ({"state": JobState.FAILED, "progress": Progress(done=185, total=302)}, "185/302"),
        ({"state": JobState.QUEUED, "progress": None}, ""),
    ],
)
def test_a_job_that_succeeded_is_listed_with_all_its_work_done(fields: dict[str, Any], shown: str) -> None:
    assert _done(a_job(size=None, **fields)) == shown


def test_what_is_wrong_with_a_file_is_told_without_the_number_of_the_error(tmp_path: Path) -> None:
    with pytest.raises(OSError) as failed:
        (tmp_path / "nowhere" / "walk.bvh").write_bytes(b"")
    assert sentence(failed.value) == (
        f"{tmp_path}/nowhere/walk.bvh: there is no folder {tmp_path}/nowhere; create it, or name another file"
    )


def test_what_is_wrong_with_a_field_is_told_once(script: ScriptedServer) -> None:
    errors = [{"pointer": "/a", "code": "bad", "detail": "no"}, {"pointer": "/b", "code": "bad", "detail": "neither"}]
    script.answers = [problem(422, "invalid", detail="/a: no", errors=errors)]
    with pytest.raises(Invalid) as raised:
        script.marey().project("lab").read()
    assert sentence(raised.value) == "/a: no; /b: neither (invalid, request req-1 at http://server.test)"


def test_a_token_that_is_refused_is_told_with_the_place_it_came_from(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusal = problem(401, "bad-token", detail="The token is unknown, expired or revoked.")
    monkeypatch.setattr("marey_client.marey.Marey", lambda url, token, **_options: answering(script, token))
    monkeypatch.setenv("MAREY_TOKEN", "marey_old")
    for anonymous, told in ((False, "the token comes from the variable MAREY_TOKEN; marey login"), (True, "unknown")):
        script.answers = [refusal]
        with pytest.raises(Unauthenticated) as refused, connect(NO_OPTIONS, anonymous=anonymous) as marey:
            marey.me()
        assert told in sentence(refused.value)
        assert ("MAREY_TOKEN" in sentence(refused.value)) is not anonymous


@pytest.mark.parametrize("what", ["job", "dataset", "script", "schedule", "webhook"])
def test_what_a_project_lacks_is_answered_with_the_command_that_lists_what_it_has(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    monkeypatch.setattr("marey_client.marey.Marey", lambda *_, **_options: script.marey())
    script.answers = [problem(404, f"no-{what}")]
    with pytest.raises(NotFound) as missing, connect(NO_OPTIONS) as marey:
        marey.me()
    assert f"`marey {what} ls PROJECT` lists the {what}s" in sentence(missing.value)


def answering(script: ScriptedServer, token: str | None) -> Marey:
    return Marey("http://server.test", token, http=httpx.MockTransport(script))


def test_a_project_that_is_not_there_is_told_before_any_byte_is_sent(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "walk.bvh").write_text("x")
    monkeypatch.setattr(uploading, "connect", lambda context: script.marey())
    script.answers = [problem(404, "no-project")]
    with pytest.raises(NotFound):
        uploading.upload(NO_OPTIONS, [tmp_path], "nowhere", {})
    assert [request.method for request in script.requests] == ["GET"]


def test_who_interrupts_the_wait_for_a_job_is_told_that_it_goes_on(
    script: ScriptedServer, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(_request: httpx.Request) -> None:
        raise KeyboardInterrupt

    script.answers = [interrupt]
    running = a_job(id="job_1", kind="retarget", state=JobState.RUNNING, progress=None)
    with pytest.raises(KeyboardInterrupt):
        follow(script.marey(), running)
    told = capsys.readouterr().err
    assert "job_1 continues on the server" in told
    assert "marey job cancel job_1" in told


@pytest.mark.parametrize("answer", [httpx.ConnectError("refused"), problem(401, "bad-token")])
def test_who_loses_the_server_while_waiting_for_a_job_is_told_the_job(script: ScriptedServer, answer: Any) -> None:
    script.answers = [answer] * 20
    running = a_job(id="job_1", kind="retarget", state=JobState.RUNNING, progress=None)
    with pytest.raises((Unreachable, Unauthenticated)) as lost:
        follow(script.marey(), running)
    assert sentence(lost.value).endswith("this does not stop job_1; `marey job show job_1` shows it")


def test_a_job_that_is_gone_is_not_said_to_go_on(script: ScriptedServer) -> None:
    script.answers = [problem(404, "no-job", detail="There is no job.")]
    running = a_job(id="job_1", kind="retarget", state=JobState.RUNNING, progress=None)
    with pytest.raises(NotFound) as gone:
        follow(script.marey(), running)
    assert "marey job show" not in sentence(gone.value)


def test_a_job_that_is_not_waited_for_is_named(script: ScriptedServer, capsys: pytest.CaptureFixture[str]) -> None:
    submitted = a_job(id="job_1", kind="retarget", state=JobState.QUEUED, progress=None)
    assert follow(script.marey(), submitted, wait=False) is None
    assert capsys.readouterr().out == "job_1\n"
    assert script.requests == []


def test_results_are_counted_as_people_count(capsys: pytest.CaptureFixture[str]) -> None:
    aligned = {
        "name": "walk", "frames": 1, "cost": 0.0, "least_slope": 1.0, "greatest_slope": 1.0,
    }  # fmt: skip
    result = {
        "clips": 1, "frames": 1, "frame_rate_hz": 30.0, "keyframes": {}, "reference": "walk", "aligned": [aligned],
        "refused": [],
    }  # fmt: skip
    print_ended(a_job(id="job_1", result=result), False, _print_aligned)
    assert capsys.readouterr().out.splitlines()[-1] == "1 clip of 1 frame at 30 Hz; 0 refused"
    print_ended(a_job(id="job_1", state=JobState.SUCCEEDED, result={"clips": 1, "frames": 86_000}), False)
    assert capsys.readouterr().out == "job_1 succeeded: 1 clip, 86,000 frames; 0 refused\n"


@pytest.mark.parametrize("as_json", [False, True])
def test_inputs_that_a_job_refused_give_status_1_however_it_is_printed(
    as_json: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    result = {"clips": 0, "labels": {}, "refused": [{"name": "walk", "code": "no-feet", "detail": "it has no feet"}]}
    with pytest.raises(Refused):
        print_ended(a_job(id="job_1", result=result), as_json, print_labelled)
    assert "it has no feet" in "".join(capsys.readouterr())


def test_warnings_about_results_are_counted_by_code(capsys: pytest.CaptureFixture[str]) -> None:
    _print_warnings({"clips": 3, "warnings": {"bones-moved-by-translations": 2}, "refused": []})
    printed = capsys.readouterr()
    assert printed.err.startswith("warning bones-moved-by-translations: 2 clips; ")
    assert printed.out == ""


def test_a_refused_merge_prints_the_segments_that_exclude_each_other(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    conflict = {
        "path": "labels", "kind": "annotation", "parts": ["annotation"], "base": None, "ours": None, "theirs": None,
        "reason": "Both sides have labelled the same frames.",
        "segments": {
            "base": [],
            "ours": [{"label": "left", "start": 0, "end": 30}, {"label": "left", "start": 40, "end": 50}],
            "theirs": [{"label": "right", "start": 0, "end": 60}],
        },
    }  # fmt: skip
    answer = {
        "commit": None, "base": None, "ours": "o", "theirs": "t", "changes": 0, "conflicts": [conflict],
        "conflict_count": 1,
    }  # fmt: skip
    monkeypatch.setattr(combining, "connect", lambda context: script.marey())
    script.answers = [problem(409, "merge-conflicts", context=answer)]
    with pytest.raises(typer.Exit):
        combining.merge(NO_OPTIONS, "lab/gaits@trial")
    printed = capsys.readouterr()
    assert re.search("labels +annotation +annotation", printed.out)
    assert printed.err.startswith(
        "labels: Both sides have labelled the same frames.\n"
        "  ours: left 0:30, left 40:50\n"
        "  theirs: right 0:60\n"
        "  base: none\n"
    )


def test_an_upload_tells_a_new_revision_from_a_new_clip(capsys: pytest.CaptureFixture[str]) -> None:
    entries = [
        ImportEntry(name="a.bvh", status="created", revision=1, frames=2),
        ImportEntry(name="b.bvh", status="created", revision=3, frames=2),
        ImportEntry(name="c.bvh", status="unchanged", revision=2, frames=2),
    ]
    _print_entries(entries)
    assert capsys.readouterr().out == "3 files: 1 created, 1 new revision, 1 unchanged; 6 frames\n"


def test_who_interrupts_an_upload_is_told_how_to_go_on(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "walk.bvh").write_text("x")

    def interrupt(_request: httpx.Request) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(uploading, "connect", lambda context: script.marey())
    script.answers = [httpx.Response(200, json=PROJECT), interrupt]
    with pytest.raises(KeyboardInterrupt):
        uploading.upload(NO_OPTIONS, [tmp_path], "lab", {})
    assert "repeating the command sends only the missing ones" in capsys.readouterr().err


def test_an_upload_that_leaves_motion_out_fails_although_all_else_went_in(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("walk.bvh", "run.fbx"):
        (tmp_path / name).write_text("x")

    def answer(request: httpx.Request) -> httpx.Response:
        if request.url.path.endswith("/blobs/missing"):
            return httpx.Response(200, json={"missing": []})
        return httpx.Response(200, json={"entries": [{"name": "walk.bvh", "status": "created", "frames": 1}]})

    monkeypatch.setattr(uploading, "connect", lambda context: script.marey())
    script.answers = [httpx.Response(200, json=PROJECT), answer, answer]
    with pytest.raises(Refused):
        uploading.upload(NO_OPTIONS, [tmp_path], "lab", {})
    told = capsys.readouterr()
    assert "left out: 1 FBX: not readable here, export as BVH (run.fbx)" in told.err
    assert told.out == "1 file: 1 created; 1 frame\n"


def test_who_interrupts_a_download_is_told_what_is_complete(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def export(folder: Path, **_: object) -> Path:
        if exported:
            raise KeyboardInterrupt
        exported.append(folder)
        return folder / "walk.bvh"

    exported: list[Path] = []
    item = cast(Any, mock.Mock(export=export))
    chosen = [downloading._Exported(item, None, "", name) for name in ("walk", "turn")]
    with pytest.raises(KeyboardInterrupt):
        downloading._download_all(chosen, tmp_path, {})
    assert f"files that are complete in {tmp_path}: at least 1 of 2; no file is cut off" in capsys.readouterr().err


def test_a_joint_without_axes_is_given_both_of_its_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    elbow = mock.Mock()
    elbow.name = "LeftForeArm"  # `Mock(name=...)` names the mock instead
    item = mock.Mock(mapping=lambda: SkeletonMapping(joints={"left_elbow": "LeftForeArm"}))
    item.hierarchy.return_value.joints = [elbow]
    monkeypatch.setattr(skeletons, "connect", mock.MagicMock())
    monkeypatch.setattr(skeletons, "require_item", lambda *_: item)
    with pytest.raises(WrongUsage, match="'LeftForeArm' has no axes yet; give it both `--twist` and `--swing`"):
        skeletons.joint_axes(mock.Mock(), "lab/rig", "LeftForeArm", twist="2,0,0")
    skeletons.joint_axes(mock.Mock(), "lab/rig", "LeftForeArm", twist="2,0,0", swing="0,1,0")
    (stated,) = item.put_mapping.call_args.args
    assert stated.method == "manual"
    assert stated.axes["LeftForeArm"].twist == (1.0, 0.0, 0.0)
    assert stated.axes["LeftForeArm"].swing == (0.0, 1.0, 0.0)


def test_a_token_whose_file_does_not_fit_on_the_disk_is_never_made(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tokens, "connect", lambda context: script.marey())
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as refused:
        tokens.create_token(NO_OPTIONS, "ci", output=tmp_path / "token")
    assert sentence(refused.value) == "No space left on device"
    assert script.requests == []
    assert not (tmp_path / "token").exists()


def test_of_many_outdated_inputs_the_first_are_named_and_the_others_counted() -> None:
    edges = tuple(
        LineageEdge(item=f"clip_{number}", kind=Kind.CLIP, name=f"walk {number}", revision=1, job=None, role="clips")
        for number in range(900)
    )
    staleness = Staleness(item="evaluation_1", revision=1, stale=True, because=edges)
    item = cast(Any, mock.Mock(project="lab", path="all walks"))
    *first, others = _stale_reasons(staleness, item)
    assert first == [f"clip walk {number} has newer revisions than 1" for number in range(3)]
    assert others == "and 897 more inputs; `marey show 'lab/all walks' --history --json` lists all"
    few = Staleness(item="evaluation_1", revision=1, stale=True, because=edges[:3])
    assert len(list(_stale_reasons(few, item))) == 3


def test_a_token_whose_file_cannot_be_written_is_never_made(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "there").write_text("precious")
    monkeypatch.setattr(tokens, "connect", lambda context: script.marey())
    with pytest.raises(FileExistsError):
        tokens.create_token(NO_OPTIONS, "ci", output=tmp_path / "there")
    assert script.requests == []
    assert (tmp_path / "there").read_text() == "precious"
    script.answers = [problem(403, "insufficient-scope")]
    with pytest.raises(Forbidden):
        tokens.create_token(NO_OPTIONS, "ci", output=tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_checkout_says_how_many_of_how_many_entries_were_taken(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(versions, "connect", lambda context: script.marey())
    counts = {"added": 300, "removed": 2, "moved": 0, "changed": 0}
    digest = "sha256:" + "a" * 64
    script.answers = [httpx.Response(200, json={"commit": digest, "taken": 300, "entries": 142220, **counts})]
    versions.checkout(NO_OPTIONS, "lab/gaits@v1", query="subject = 02", path=["/raw/"])
    sent = json.loads(script.requests[0].content)
    assert sent == {"version": "v1", "query": "subject = 02", "paths": ["raw"], "discard": False}
    assert capsys.readouterr().err == (
        "the folder has 300 of 142,220 entries of aaaaaaaaaaaa now: 300 added, 2 removed\n"
    )


def test_a_conflict_cannot_be_decided_for_two_sides() -> None:
    [one, same] = resolutions_of(None, ["raw/a:clip", "raw/a:clip"], None)
    assert one == same
    with pytest.raises(WrongUsage, match="two of --ours, --theirs and --base resolve"):
        resolutions_of(["raw/a:clip"], None, ["/raw/a:clip"])
    with pytest.raises(WrongUsage, match="two of --ours, --theirs and --base resolve"):
        resolutions_of(["raw/a:clip"], ["raw/a:clip/motion"], None)


def test_the_parts_of_a_conflict_are_decided_for_different_sides() -> None:
    found = resolutions_of(["raw/a:clip/motion"], ["raw/a:clip/info"], None)
    assert [(one.path, one.kind, one.take, one.part) for one in found] == [
        ("raw/a", "clip", "ours", "motion"),
        ("raw/a", "clip", "theirs", "info"),
    ]


def test_a_token_is_bound_to_labels_and_listed_with_them(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tokens, "connect", lambda context: script.marey())
    token = {
        "id": "token_1", "name": "w", "prefix": "abc", "scopes": ["work"], "expires_at": None, "user": "ada",
        "created_at": "2026-01-01T00:00:00Z", "labels": {"site": "lyon", "gpu": "a100"},
    }  # fmt: skip
    script.answers = [httpx.Response(201, json={**token, "secret": "marey_abc_def"})]
    tokens.create_token(NO_OPTIONS, "w", scope=["work"], label=["gpu=a100", "site=lyon"])
    assert json.loads(script.requests[0].content)["labels"] == {"gpu": "a100", "site": "lyon"}
    with pytest.raises(WrongUsage, match="write name=value"):
        tokens.create_token(NO_OPTIONS, "w", scope=["work"], label=["lyon"])
    listed = [token, {**token, "labels": {}}, {**token, "labels": None}]
    script.answers = [httpx.Response(200, json={"items": listed, "next_cursor": None})]
    capsys.readouterr()
    tokens.list_tokens(NO_OPTIONS)
    header, *rows = (line for line in capsys.readouterr().out.splitlines() if "id" in line or "token_1" in line)
    assert "labels" in header
    assert ["gpu=a100 site=lyon" in row for row in rows] == [True, False, False]
    assert ["none" in row for row in rows] == [False, True, False]


SUCCESSOR = {
    "id": "token_2", "name": "w", "prefix": "bbb", "scopes": ["work"], "expires_at": None, "user": "ada",
    "created_at": "2026-01-01T00:00:00Z", "successor_of": "token_1", "secret": "marey_bbb_new",
}  # fmt: skip
ME = {"user": None, "scopes": ["work"], "token": "token_1"}
SERVER = "http://server.test"


@pytest.fixture
def rotating(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[[Credential], list[Any]]:
    """Function that runs `marey token rotate` with a credential; returns the ids of all rotations sent so far."""

    def rotate(credential: Credential) -> list[Any]:
        monkeypatch.setattr(tokens, "connect", lambda context: script.marey())
        monkeypatch.setattr(tokens, "credential_of", lambda context: credential)
        script.answers += [httpx.Response(200, json=ME), httpx.Response(200, json=SUCCESSOR)]
        tokens.rotate_token(NO_OPTIONS)
        sent = [one for one in script.requests if one.method == "POST"]
        assert {one.url.path for one in sent} == {"/api/v1/tokens/token_1/rotate"}
        assert {one.headers["Authorization"] for one in script.requests} == {"Bearer marey_aaa_old"}
        return [json.loads(one.content)["rotation_id"] for one in sent]

    return rotate


def test_a_rotated_token_is_in_its_file_and_never_shown(
    rotating: Callable[[Credential], list[Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "worker.token"
    write_private(file, "marey_aaa_old\n")
    rotating(Credential(SERVER, "marey_aaa_old", str(file), file=file))
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("worker.token", "marey_bbb_new\n")]
    shown = capsys.readouterr()
    assert "token_2 is in" in shown.out + shown.err
    assert "bbb" not in shown.out + shown.err


def test_a_rotated_login_replaces_only_the_token_of_its_server(
    rotating: Callable[[Credential], list[Any]], tmp_path: Path
) -> None:
    path = tmp_path / "credentials.json"
    store_login(path, SERVER, "marey_aaa_old")
    store_login(path, "http://other.test", "other")
    rotating(Credential(SERVER, "marey_aaa_old", "marey login", logins=path))
    assert read_logins(path) == Logins("http://other.test", {SERVER: "marey_bbb_new", "http://other.test": "other"})


def test_a_rotation_that_was_killed_before_the_token_was_stored_is_repeated_with_the_same_id(
    rotating: Callable[[Credential], list[Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "worker.token"
    write_private(file, "marey_aaa_old\n")
    credential = Credential(SERVER, "marey_aaa_old", str(file), file=file)

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("marey_client.credentials.replace_token", die)
        with pytest.raises(KeyboardInterrupt):
            rotating(credential)
    assert file.read_text() == "marey_aaa_old\n"
    first, again = rotating(credential)
    assert first == again
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("worker.token", "marey_bbb_new\n")]


def test_the_id_of_another_rotation_is_not_used_again(
    rotating: Callable[[Credential], list[Any]], tmp_path: Path
) -> None:
    file = tmp_path / "worker.token"
    write_private(file, "marey_aaa_old\n")
    write_private(tmp_path / "worker.token.rotation", f"bbb {'b' * 32}\n")
    [sent] = rotating(Credential(SERVER, "marey_aaa_old", str(file), file=file))
    assert sent != "b" * 32


def test_a_token_in_a_variable_is_not_rotated(
    rotating: Callable[[Credential], list[Any]], script: ScriptedServer
) -> None:
    with pytest.raises(BadCredentialFile, match="--token-file"):
        rotating(Credential(SERVER, "marey_aaa_old", "the variable MAREY_TOKEN"))
    assert script.requests == []


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("login",), "--with-token"),
        (("login", "--name", "ada"), "standard input"),
        (("user", "create", "ada"), "standard"),
    ],
)
def test_without_a_terminal_nobody_is_asked_and_one_line_says_what_to_do(
    arguments: tuple[Any, ...], told: str, nowhere: dict[str, str]
) -> None:
    done = marey_here(arguments, nowhere)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert told in done.stderr


def test_a_password_may_be_piped(nowhere: dict[str, str]) -> None:
    done = marey_here(["login", "--name", "ada"], nowhere, stdin="correct horse battery\n")
    assert done.returncode == 1
    assert done.stderr.startswith("marey: http://127.0.0.1:9 does not answer")


@pytest.mark.parametrize("command", ["download", "sample", "search", "report", "evaluate", "compare"])
def test_where_files_go_is_called_the_same_by_every_command(command: str) -> None:
    told = marey_here([command, "--help"], {}).stdout
    assert all(name in told for name in ("--out", "--output", "-o"))


def test_what_a_step_found_nothing_in_is_counted_as_people_count(capsys: pytest.CaptureFixture[str]) -> None:
    for empty, told in ((["raw/walk"], "in raw/walk"), (["raw/a", "raw/b"], "in 2 clips, such as raw/a")):
        job = a_job(result={"empty": empty})
        _print_shortfalls(PipelineRun(cast(Any, None), {"annotate": job}))
        assert capsys.readouterr().err == f"annotate found nothing {told}\n"


def test_version_is_told() -> None:
    done = marey_here(["--version"], {})
    assert done.stdout.startswith("marey ")


def test_at_a_narrow_terminal_ids_stay_in_one_piece_and_moments_are_told_to_the_second(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    an_id = "token_01m80ke8tqf73e4b2grvtajq5j"
    made = datetime(2026, 11, 22, 3, 5, 58, 123456, UTC)
    name = "workers beside the server at 127.0.0.1:8460 on a machine with a long name"
    print_table(("id", "name", "scopes", "last used"), [(an_id, name, "read write work", made)])
    printed = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert an_id in printed
    assert max(map(len, printed.splitlines())) <= 80
    assert "03:05:58Z" in printed


@pytest.mark.parametrize(("typed", "meant"), [(["UPLOAD"], "upload"), (["help", "upload"], "upload --help")])
def test_capital_letters_and_help_are_answered_with_the_command(typed: list[str], meant: str) -> None:
    answered = run_here(typed)
    assert answered.returncode == 2
    assert f"No such command '{typed[0]}'. Type: marey {meant}\n" in answered.stderr


def test_names_of_other_programs_are_answered_with_a_command_that_exists() -> None:
    every_command: Any = typer.main.get_command(app)
    for typed, meant in OTHER_NAMES.items():
        assert typed not in every_command.commands
        answered = run_here([typed, "lab"])
        assert answered.returncode == 2
        assert f"No such command '{typed}'. Type: marey {meant}" in answered.stderr
        group = every_command
        for word in meant.split():
            if word.startswith("--"):
                assert any(word in option.opts for option in group.params)
            elif word in getattr(group, "commands", {}):
                group = group.commands[word]
            else:
                assert word in set(Kind), word


def test_ready_tells_by_its_status_whether_the_server_is_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAREY_URL", "http://server.test")
    server = ScriptedServer()
    server.answers = [httpx.Response(200, json={"status": "ready"}), problem(503, "not-ready", retry_after=5)]
    with mock.patch("marey_client.marey.Marey", partial(Marey, http=httpx.MockTransport(server))):
        ready, refused = run_here(["ready"]), run_here(["ready"])
    assert (ready.returncode, ready.stderr) == (0, "http://server.test is ready\n")
    assert refused.returncode == 1
    assert "the reason" in refused.stderr
    assert [request.url.path for request in server.requests] == ["/readyz", "/readyz"]
    assert all("Authorization" not in request.headers for request in server.requests)


def test_times_of_jobs_are_told_in_their_largest_unit() -> None:
    now = datetime(2026, 11, 29, 12, 0, 0, tzinfo=UTC)
    lengths = (-5, 0, 59, 60, 3_599, 3_600, 86_399, 86_400 * 40)
    told = [ago(now - timedelta(seconds=seconds), now) for seconds in lengths]
    assert told == ["0 s ago", "0 s ago", "59 s ago", "1 min ago", "59 min ago", "1 h ago", "23 h ago", "40 d ago"]

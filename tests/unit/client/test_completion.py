"""Shell completion without a server: lines, answers for shells, the table of subjects, and failures."""

import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar
from unittest import mock

import pytest
import typer
from tests.support.command_line import run_here

from marey_client.cli.app import app
from marey_client.cli.completion.asking import MOST_PAGES, PATIENCE_S
from marey_client.cli.completion.found import Suggestion, Typed, nothing
from marey_client.cli.completion.shells import FILES, SCRIPTS, Line, answer_text, read_line
from marey_client.cli.completion.subjects import SUBJECTS, how_to_complete
from marey_client.credentials import store_login
from marey_schemas.kinds import Kind


def suggested(line: str, *, shell: str = "bash", **environment: str) -> tuple[int, list[str]]:
    """Return the exit status and the lines of the answer to a shell."""
    asked = {"_MAREY_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_ARGS": line, **environment}
    with mock.patch.dict(os.environ, asked):
        done = run_here([])
    assert done.stderr == ""
    return done.returncode, done.stdout.splitlines()


@pytest.fixture
def nowhere(tmp_path: Path) -> dict[str, str]:
    """Environment of a user who has never logged in, with the address of a server that does not exist."""
    return {"XDG_CONFIG_HOME": str(tmp_path), "MAREY_DATA": str(tmp_path), "MAREY_SERVER": "http://127.0.0.1:9"}


@pytest.mark.parametrize(
    ("typed", "words", "start"),
    [
        ("marey show lab/wa", ("show",), "lab/wa"),
        ("marey show ", ("show",), ""),
        (r"marey show lab/my\ takes/a", ("show",), "lab/my takes/a"),
        ("marey show 'lab/my takes/a", ("show",), "lab/my takes/a"),
        ('marey mv "lab/a b" "lab/c', ("mv", "lab/a b"), "lab/c"),
        (r'marey show "lab/\"x\" \d', ("show",), 'lab/"x" \\d'),
        ("marey show lab/'a b'c", ("show",), "lab/a bc"),
        ("marey show lab/it\\'s", ("show",), "lab/it's"),
        ("marey show '' ", ("show", ""), ""),
        ("marey show ladder/größe", ("show",), "ladder/größe"),
        ("marey", (), "marey"),
    ],
)
def test_a_line_is_split_as_shells_split_it(typed: str, words: tuple[str, ...], start: str) -> None:
    line = Line.parse(typed)
    assert (line.words, line.start) == (words, start)


def test_lines_of_earlier_scripts_are_read() -> None:
    line = read_line({"COMP_WORDS": "marey\nshow\nlab/my\\ takes\n", "COMP_CWORD": "2"})
    assert (line.words, line.start) == (("show",), "lab/my takes")
    assert read_line({"COMP_WORDS": "marey show ", "COMP_CWORD": "2"}).start == ""


def test_powershell_gets_a_remark_and_quoted_text() -> None:
    found = [Suggestion("lab/", "Motion lab"), Suggestion("lab/it’s $x;y"), Suggestion("a:::b"), Suggestion("--json")]
    shown = ["lab/:::Motion lab", "'lab/it’’s $x;y':::lab/it’s $x;y", "--json:::--json"]
    assert answer_text("powershell", Line.parse("marey show "), found).splitlines() == shown


def test_the_space_that_powershell_leaves_out_is_added() -> None:
    line = {"_TYPER_COMPLETE_ARGS": "marey show", "_TYPER_COMPLETE_WORD_TO_COMPLETE": ""}
    assert read_line(line) == Line(("show",), "", "")
    assert read_line({**line, "_TYPER_COMPLETE_WORD_TO_COMPLETE": "show"}) == Line((), "show", "show")


def test_other_shells_get_remarks_in_one_line() -> None:
    found = [Suggestion("walk", "two\nlines\t"), Suggestion("run")]
    assert answer_text("fish", Line.parse("marey show "), found) == "walk\ttwo lines \nrun"


def test_names_with_control_characters_are_not_shown() -> None:
    found = [Suggestion("a\nb"), Suggestion("a\x1b[31mb"), Suggestion("ab")]
    assert answer_text("zsh", Line.parse("marey show "), found) == "ab"


def test_commands_options_and_choices_are_completed_without_a_server(nowhere: dict[str, str]) -> None:
    assert suggested("marey data", **nowhere) == (0, ["dataset"])
    assert suggested("marey dataset che", **nowhere) == (0, ["checkout", "cherry-pick"])
    assert suggested("marey retarget lab --keep-f", **nowhere)[1] == ["--keep-feet"]
    assert suggested("marey ls lab --kind sk", **nowhere)[1] == ["skeleton"]
    assert suggested("marey ls lab --columns kind,fra", **nowhere)[1] == ["kind,frames"]
    assert "failed" in suggested("marey job ls lab --state ", **nowhere)[1]
    assert suggested("marey --show-completion z", **nowhere)[1] == ["zsh"]


def test_files_are_left_to_the_shell(nowhere: dict[str, str]) -> None:
    assert suggested("marey upload /tm", **nowhere) == (FILES, [])
    assert suggested("marey record lab --table ", **nowhere) == (FILES, [])
    assert suggested("marey project create l", **nowhere) == (0, [])


@pytest.mark.parametrize("shell", sorted(SCRIPTS))
@pytest.mark.parametrize("line", ["marey show lab/", "marey ls ", "marey job show ", "marey retarget lab --to lab/"])
def test_without_a_server_there_are_no_suggestions_and_no_error(line: str, shell: str, nowhere: dict[str, str]) -> None:
    assert suggested(line, shell=shell, **nowhere) == (0, [])


@pytest.mark.parametrize(
    "broken",
    [
        {"MAREY_SERVER": "not an address"},
        {"MAREY_TOKEN": "two words\nand a line"},
        {"COMP_CWORD": "x"},
        {"_MAREY_COMPLETE": "complete_unknown"},
    ],
)
def test_wrong_settings_give_no_error(broken: dict[str, str], nowhere: dict[str, str]) -> None:
    status, lines = suggested("marey show lab/", **{**nowhere, **broken})
    assert status in (0, 1)
    assert lines == []


def test_a_token_file_that_others_may_read_is_not_used(nowhere: dict[str, str], tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("marey_secret")
    token.chmod(0o644)
    assert suggested(f"marey --token-file {token} show lab/", **nowhere) == (1, [])


def test_damaged_logins_give_no_error(nowhere: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "marey").mkdir()
    (tmp_path / "marey" / "credentials.json").write_text("{")
    assert suggested("marey show lab/", **nowhere) == (1, [])


@pytest.fixture
def silent_server() -> Iterator[str]:
    """Address of a server that accepts connections and sends one byte every 50 ms, but no answer."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listener:
        threading.Thread(target=_trickle, args=[listener], daemon=True).start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"


def _trickle(listener: socket.socket) -> None:
    while True:
        try:
            one, _ = listener.accept()
        except OSError:
            return
        threading.Thread(target=_drip, args=[one], daemon=True).start()


def _drip(connection: socket.socket) -> None:
    try:
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 1000000\r\n\r\n[")
        for _ in range(200):
            connection.sendall(b" ")
            time.sleep(0.05)
    except OSError:
        return


def test_a_slow_server_is_given_up_after_about_a_second(silent_server: str, nowhere: dict[str, str]) -> None:
    suggested("marey show lab/", **nowhere)  # loads modules
    began = time.monotonic()
    assert suggested("marey show lab/", **{**nowhere, "MAREY_SERVER": silent_server}) == (0, [])
    assert PATIENCE_S * 0.9 < time.monotonic() - began < PATIENCE_S + 5  # machines of tests are busy
    assert PATIENCE_S <= 1


def test_completion_loads_nothing_heavy(nowhere: dict[str, str]) -> None:
    probe = (
        "import sys; from marey_client.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'httpx', 'rich', 'bson', 'marey_motion', 'marey_schemas.queue.job_params'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    for line in ("marey show lab/", "marey retarget lab/raw --to lab/", "marey upload --project l"):
        asked = {"_MAREY_COMPLETE": "complete_zsh", "_TYPER_COMPLETE_ARGS": line, **nowhere}
        command = [sys.executable, "-c", probe]
        done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **asked})
        assert (done.stdout, done.stderr) == ("[]\n", ""), line


class _Recorder(BaseHTTPRequestHandler):
    """Handler that answers every request with a page of an endless list, and records the tokens."""

    tokens: ClassVar[list[str | None]] = []

    def do_GET(self) -> None:
        self.tokens.append(self.headers.get("Authorization"))
        page = json.dumps({"items": [{"name": "lab", "path": "lab"}], "next_cursor": "more"}).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(page)))
        self.end_headers()
        self.wfile.write(page)

    def log_message(self, format: str, *args: Any) -> None: ...  # noqa: A002 - the name of the parent


@pytest.fixture
def recorder() -> Iterator[str]:
    """Address of a server that records the tokens that it gets."""
    _Recorder.tokens.clear()
    with ThreadingHTTPServer(("127.0.0.1", 0), _Recorder) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_a_list_without_end_is_given_up(recorder: str, nowhere: dict[str, str]) -> None:
    assert suggested("marey project show l", **{**nowhere, "MAREY_SERVER": recorder}) == (0, ["lab"])
    assert 0 < len(_Recorder.tokens) <= MOST_PAGES


def test_an_address_on_the_line_gets_no_token_of_another(
    recorder: str, nowhere: dict[str, str], tmp_path: Path
) -> None:
    for name in ("token", "admin.token"):
        (tmp_path / name).write_text("marey_secret")
        (tmp_path / name).chmod(0o600)
    for line in (f"--server {recorder}", f"--token-file {tmp_path / 'token'} --server={recorder}"):
        suggested(f"marey {line} show lab/", **nowhere, MAREY_TOKEN="marey_secret")
        suggested(f"marey {line} show lab/", **nowhere)
    assert set(_Recorder.tokens) == {None}


def test_an_address_on_the_line_gets_its_own_token(recorder: str, nowhere: dict[str, str], tmp_path: Path) -> None:
    line = f"marey --server {recorder}/ show lab/"
    suggested(line, **{**nowhere, "MAREY_SERVER": recorder}, MAREY_TOKEN="marey_of_environment")
    (tmp_path / "marey").mkdir()
    store_login(tmp_path / "marey" / "credentials.json", recorder, "marey_saved")
    suggested(line, **nowhere, MAREY_TOKEN="marey_of_environment")
    assert set(_Recorder.tokens) == {"Bearer marey_of_environment", "Bearer marey_saved"}


def test_an_address_of_ipv6_without_a_port_is_asked_at_port_80(nowhere: dict[str, str]) -> None:
    with mock.patch("socket.create_connection", side_effect=OSError) as connect:
        suggested("marey show lab/", **{**nowhere, "MAREY_SERVER": "http://[::1]"})
    assert {call.args[0] for call in connect.call_args_list} == {("::1", 80)}


def test_no_answer_of_the_table_contains_a_text_twice(nowhere: dict[str, str]) -> None:
    with mock.patch.dict(os.environ, nowhere):
        for key, how in SUBJECTS.items():
            texts = [one.text for one in how(Typed("", {}))]
            assert len(texts) == len(set(texts)), key


def _declared() -> Iterator[tuple[tuple[str, ...], str, str]]:
    """Yield each parameter of each command: the words of the command, name and help."""
    waiting: list[tuple[tuple[str, ...], Any]] = [((), typer.main.get_command(app))]
    while waiting:
        names, command = waiting.pop()
        if hasattr(command, "commands"):
            waiting += [((*names, name), one) for name, one in command.commands.items()]
            continue
        for one in command.get_params(typer.Context(command, info_name=names[-1])):
            yield names, str(one.name), str(getattr(one, "help", "") or "")


def test_every_address_and_every_id_of_a_job_is_completed() -> None:
    marks = ("project/folder", "project/id", "Name of the project;", "`marey job ls` lists the ids", "lab/gaits")
    of_other_forms = {"trim"}  # project/folder/clip=first:stop
    missing = [
        f"{' '.join(command)} {name}"
        for command, name, meaning in _declared()
        if any(mark in meaning for mark in marks) and name not in of_other_forms
        if how_to_complete(command, name) is None
    ]
    assert missing == []


def test_no_parameter_takes_an_item_by_its_id_only() -> None:
    kinds = "|".join(kind.value for kind in Kind)
    of_item = re.compile(rf"\bids? of (?:the|an?) (?:{kinds})\b", re.IGNORECASE)
    by_id = [
        f"{' '.join(command)} {name}"
        for command, name, meaning in _declared()
        if of_item.search(meaning) and "path" not in meaning and "project/" not in meaning
    ]
    assert by_id == []


def test_no_entry_of_the_table_is_unused() -> None:
    used = set()
    for command, name, _ in _declared():
        keys = [" ".join([*command[:length], name]) for length in range(len(command), -1, -1)]
        used.update(next(([key] for key in keys if key in SUBJECTS), []))
    assert set(SUBJECTS) - used == set()


def test_new_names_are_not_completed() -> None:
    assert how_to_complete(("project", "create"), "name") is nothing
    assert how_to_complete(("annotation", "create"), "name") is None


def test_scripts_are_shown_and_are_valid_bash() -> None:
    for shell, script in SCRIPTS.items():
        assert run_here(["--show-completion", shell]).stdout == script
    done = subprocess.run(["bash", "--norc", "-n"], input=SCRIPTS["bash"], text=True, capture_output=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_bash_shows_what_marey_answers(tmp_path: Path) -> None:
    program = tmp_path / "marey"
    program.write_text('#!/bin/sh\nprintf "%s\\n" "$_MAREY_COMPLETE" "$_TYPER_COMPLETE_ARGS"\n')
    program.chmod(0o755)
    script = (
        f'{SCRIPTS["bash"]}\ncompopt() {{ echo compopt "$@"; }}\n'
        "COMP_LINE='marey show lab/x y' COMP_POINT=16 COMP_WORDBREAKS=' @' _marey_completion\n"
        'printf "<%s>\\n" "${COMPREPLY[@]}"\n'
    )
    environment = {**os.environ, "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(["bash", "--norc"], input=script, text=True, capture_output=True, env=environment)
    assert done.stdout.splitlines() == ["<complete_bash>", "<marey show lab/x>"]


def test_an_installed_script_is_ours(tmp_path: Path) -> None:
    with (
        mock.patch.dict(os.environ, {"HOME": str(tmp_path)}),
        mock.patch("typer.completion.install", return_value=("bash", tmp_path / "marey.sh")),
    ):
        done = run_here(["--install-completion"])
    assert (tmp_path / "marey.sh").read_text() == SCRIPTS["bash"]
    assert str(tmp_path / "marey.sh") in done.stdout

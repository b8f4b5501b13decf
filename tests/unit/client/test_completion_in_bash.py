"""Shell completion in bash: inserted names are quoted, so that bash never executes names from the server."""

import os
import pty
import select
import threading
from pathlib import Path

import pytest

from marey_client.cli.completion.found import Suggestion
from marey_client.cli.completion.shells import SCRIPTS, Line, answer_text

WAIT_S = 60


@pytest.mark.parametrize(
    ("typed", "replaced", "text", "shown"),
    [
        ("lab/my", "lab/my", "lab/my takes/", r"lab/my\ takes/"),
        ("lab/", "lab/", "lab/$(reboot)", r"lab/\$\(reboot\)"),
        (r"lab/\$", r"lab/\$", "lab/$x", r"lab/\$x"),
        ("lab/a\\", "lab/a\\", "lab/a b", r"lab/a\ b"),
        ("'lab/my", "lab/my", "lab/it's here", r"lab/it'\''s here"),
        ('"lab/my', "lab/my", "lab/$(reboot) `x`", r"lab/\$(reboot) \`x\`"),
        ('"lab/my', "lab/my", "lab/my!x", r'lab/my"\!"x'),
        ('odd/"m', "m", "odd/my x/", "my x/"),
        ('"odd/h s/"', '"odd/h s/"', "odd/h s/one;x", r"odd/h\ s/one\;x"),
        ("'odd'/m", "'odd'/m", "odd/my x/", r"odd/my\ x/"),
        ('"a"b/', '"a"b/', "ab/!x", r"ab/\!x"),
        ('lab/"', "", "lab/!x", r'""\!"x'),
        ("lab/'", "", "lab/'x'", r"""''\''x'\'''"""),
        ('"lab/a', "lab/a", 'lab/a"', 'lab/a\\""'),
        ("lab/gaits@v", "@v", "lab/gaits@v1", "@v1"),
        ("lab/walk:", "", "lab/walk: fast", r"\ fast"),
        ("--to=lab/s", "lab/s", "--to=lab/studio", "lab/studio"),
        ("", "", "lab/", "lab/"),
    ],
)
def test_bash_gets_what_it_inserts(typed: str, replaced: str, text: str, shown: str) -> None:
    assert answer_text("bash", Line.parse(f"marey show {typed}", replaced), [Suggestion(text)]) == shown


@pytest.mark.parametrize(
    ("typed", "replaced", "text"),
    [
        ("$'a", "a", "$a;x"),
        ("$x", "$x", "$x;y"),
        ('"`a', "`a", "`a;x"),
        ("x>y", "y", "x>y;z"),
        ('"lab/x', '"lab/x', "lab/x;y"),
        ('lab/"x', 'lab/"x', "lab/x;y"),
        ("lab/x", "something else", "lab/x;y"),
        ("lab/x", "x", "other/x;y"),
        ("'lab/x", None, "lab/x;y"),
    ],
)
def test_bash_gets_nothing_where_it_might_read_more_than_text(typed: str, replaced: str | None, text: str) -> None:
    assert answer_text("bash", Line.parse(f"marey show {typed}", replaced), [Suggestion(text)]) == ""


class Bash:
    """Interactive bash at a terminal; its command `marey` completes names that the test gives."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for pipe in ("asked", "answer"):
            os.mkfifo(folder / pipe)
        (folder / "rc").write_text(f"{SCRIPTS['bash']}{_MAREY}", encoding="utf-8")

    def arguments(self, keys: str, *names: str) -> list[str] | None:
        """Type keys and Enter; return the arguments that `marey` got, or None if a quote was still open."""
        (self.folder / "ran").unlink(missing_ok=True)
        server = threading.Thread(target=self._serve, args=[names], daemon=True)
        server.start()
        process, terminal = pty.fork()
        if process == 0:
            os.chdir(self.folder)
            os.execvpe("bash", ["bash", "--noprofile", "--rcfile", "rc", "-i"], {**os.environ, "TERM": "dumb"})
        os.write(terminal, f"{keys}\r".encode())
        for _ in range(200):
            if _read_to_end(terminal):
                break
            os.write(terminal, b"\x04")  # the end of the input ends an open quote
        os.close(terminal)
        os.waitpid(process, 0)
        (self.folder / "asked").write_text("")
        server.join(WAIT_S)
        ran = self.folder / "ran"
        return ran.read_text(encoding="utf-8").split("\0")[:-1] if ran.exists() else None

    def _serve(self, names: tuple[str, ...]) -> None:
        while asked := (self.folder / "asked").read_text(encoding="utf-8"):
            typed, replaced, _ = asked.split("\0")
            line = Line.parse(typed, replaced)
            found = [Suggestion(one) for one in names if one.startswith(line.start)]
            # As the server does: step by step.
            steps = {one.text[: one.text.find("/", len(line.start)) + 1] or one.text: None for one in found}
            text = answer_text("bash", line, [Suggestion(one) for one in steps])
            (self.folder / "answer").write_text(text, encoding="utf-8")


_MAREY = r"""
HISTFILE=/dev/null
set -o history -H
history -s 'touch harm'
PROMPT_COMMAND='(( shown++ )) && exit'
marey() {
    if [[ $_MAREY_COMPLETE ]]; then
        printf '%s\0%s\0' "$_TYPER_COMPLETE_ARGS" "$_MAREY_REPLACED" > asked
        printf '%s\n' "$(<answer)"
    else
        printf '%s\0' "$@" > ran
    fi
}
"""


def _read_to_end(terminal: int) -> bool:
    """Read what bash shows; return whether it has ended. Stop if it has shown nothing for a while."""
    while select.select([terminal], [], [], 0.3)[0]:
        try:
            if not os.read(terminal, 1 << 16):
                return True
        except OSError:  # Linux reports the end of the other side as an error
            return True
    return False


@pytest.fixture
def bash(tmp_path: Path) -> Bash:
    """Interactive bash."""
    return Bash(tmp_path)


ODD = "x;touch harm&touch harm|`touch harm`$(touch harm)>harm #\"'!t !! \\ *~{a,b}"


@pytest.mark.every_nth(3)
@pytest.mark.parametrize(
    "keys",
    [
        "odd/h\t\t", '"odd/h\t\t', "'odd/h\t\t", '"odd"/h\t\t', "'odd'/h\t\t", 'odd/"h\t\t', "odd/'h\t\t",
        'o"d"d/h\t\t', '"odd/"h\t\t', "odd/h\\ s/x\t", '"odd/h s/"x\t', '"odd/h s/x\t', "'odd/h s/x\t",
        "odd/'h s'/x\t", 'odd/h" s/x\t',
    ],
)  # fmt: skip
def test_names_of_others_run_no_command(bash: Bash, keys: str) -> None:
    name = f"odd/h s/{ODD}"
    assert bash.arguments(f"marey ls {keys}", name) == ["ls", name]
    assert not (bash.folder / "harm").exists()


@pytest.mark.every_nth(4)
@pytest.mark.parametrize("quote", ["", '"', "'"])
@pytest.mark.parametrize(
    "name", ["!t", "'", '"', "!", "a!", "a'", 'a"', "a\\", "'!;touch harm", '";touch harm;"', "$x`"]
)
def test_names_that_begin_or_end_with_signs_are_text(bash: Bash, quote: str, name: str) -> None:
    assert bash.arguments(f"marey ls odd/{quote}\t", f"odd/{name}") == ["ls", f"odd/{name}"]
    assert not (bash.folder / "harm").exists()


@pytest.mark.parametrize("quote", ["", '"', "'"])
def test_several_names_are_text(bash: Bash, quote: str) -> None:
    names = [f"odd/{ODD}{end}" for end in ("", "1", "!t", "'", '"', ";touch harm")]
    got = bash.arguments(f"marey ls {quote}odd/\t\t1\t", *names)
    assert got is None or got == ["ls", names[1]]
    assert not (bash.folder / "harm").exists()


@pytest.mark.parametrize(
    "keys", ['"odd/h\x1b*', '"odd/h"\x02\t\t', "'odd/h'\x02\t\t", '"odd/h"\x02\t\x05\t', "odd/h\x1b*"]
)
def test_other_keys_run_no_command(bash: Bash, keys: str) -> None:
    bash.arguments(f"marey ls {keys}", f"odd/h {ODD}", f"odd/h {ODD}2", "odd/h s/;touch harm")
    bash.arguments(f"marey ls {keys}", f"odd/h {ODD}")
    bash.arguments(f"marey ls {keys}", f"odd/h {ODD}/{ODD}")
    assert not (bash.folder / "harm").exists()


def test_versions_and_values_of_options_are_completed(bash: Bash) -> None:
    assert bash.arguments("marey ls lab/gaits@\t", "lab/gaits@v1") == ["ls", "lab/gaits@v1"]
    assert bash.arguments("marey ls --to=la\tst\t", "--to=lab/studio x") == ["ls", "--to=lab/studio x"]


def test_suggestions_are_no_patterns_of_files(bash: Bash) -> None:
    (bash.folder / "odd").mkdir()
    (bash.folder / "odd" / "file").touch()
    assert bash.arguments('marey ls "odd/\t', "odd/*") == ["ls", "odd/*"]
    assert bash.arguments("marey ls nothing\t", "odd/*") == ["ls", "nothing"]

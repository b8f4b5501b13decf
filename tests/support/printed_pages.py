"""Pages of the documentation whose commands and Python examples tests run as printed, in their order."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.support.command_line import CommandLine

ROOT = Path(__file__).parents[2]


def blocks(page: str) -> list[tuple[str, str]]:
    """Return (language, text) of each block of commands and of Python on a page, in their order."""
    text = (ROOT / page).read_text(encoding="utf-8")
    found = re.findall(r"^( *)```(sh|python|console)\n(.*?)^ *```$", text, re.DOTALL | re.MULTILINE)
    return [(language, re.sub(rf"^{indent}", "", block, flags=re.MULTILINE)) for indent, language, block in found]


def commands_of(language: str, block: str) -> list[str]:
    """Return the commands of a block, without prompts, outputs and comments, each on one line."""
    lines = re.sub(r"\\\n *", "", block).splitlines()
    if language == "console":
        lines = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
    return [line for line in (re.sub(r"(^| +)# .*| {2,}#.*", "", one).strip() for one in lines) if line]


@dataclass
class PrintedPage:
    """A page whose blocks a test runs with `run`, in the folder of `run`, as a reader who types them.

    The other fields name beginnings of lines. Each must occur on the page, so that none remains after a change of the
    page.
    """

    page: str
    run: CommandLine
    replaced: Mapping[str, str] = field(default_factory=dict)
    """Examples on the page which readers replace by their own names, and what this reader writes instead."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Lines that no test can run, each with the reason."""
    shortened: Mapping[str, tuple[object, ...]] = field(default_factory=dict)
    """Lines that take long, each with more options which make it quick."""
    inputs: Mapping[str, str] = field(default_factory=dict)
    """Lines that ask questions, each with the answers."""
    variables: dict[str, str] = field(default_factory=dict)
    """Environment variables of the commands; `export` on the page adds to them."""
    names: dict[str, Any] = field(default_factory=dict)
    """Names that the Python examples share."""

    def __post_init__(self) -> None:
        self._left = blocks(self.page)
        self._printed: dict[str, str] = {}
        self._used: set[str] = set()

    def follow(self, count: int | None = None) -> None:
        """Run the next `count` blocks, or all that are left."""
        for language, block in self._left[:count]:
            if language == "python":
                told = self.run.execute(self._as_replaced(block), self.names, self.page)
                self._printed[block] = " ".join(told.split())
            else:
                for line in commands_of(language, block):
                    self._type(line)
        del self._left[: count or len(self._left)]
        if not self._left:
            unused = {*self.replaced, *self.left_out, *self.shortened, *self.inputs} - self._used
            assert not unused, f"{self.page} does not contain {unused}"

    def printed(self, beginning: str) -> str:
        """Return the words which this line printed, or else the last line with this beginning; one space parts them."""
        begun = [text for line, text in self._printed.items() if line.startswith(beginning)]
        return self._printed.get(beginning, begun[-1])

    def _type(self, line: str) -> None:
        if self._of(self.left_out, line):
            return
        command = self._as_replaced(line)
        redirected = re.fullmatch(r"(marey .*) > ([\w./-]+)", command)
        command, file = redirected.groups() if redirected else (command, None)
        if re.match(r"(export )?\w+=", command):
            self.variables |= dict(word.split("=", 1) for word in self._words(command.removeprefix("export ")))
            return
        if not command.startswith("marey "):
            self._printed[line] = self._run_other(command)
            return
        words = self._words(command)
        more = self._of(self.shortened, line) or ()
        typed = self._of(self.inputs, line) or ""
        done = self.run(*words[1:], *more, status=0, stdin=typed, **self.variables)
        if file:
            (self.run.folder / file).write_text(done.stdout, encoding="utf-8")
        self._printed[line] = " ".join((done.stdout + done.stderr).split())

    def _words(self, command: str) -> list[str]:
        """Return the words of a command, as bash expands them in the folder of the reader."""
        return self._run_other(f"printf '%s\\0' {command}").split("\0")[:-1]

    def _run_other(self, command: str) -> str:
        """Run a command of another program than `marey` in bash, and return what it prints."""
        home = {"PATH": os.environ["PATH"], "HOME": str(self.run.folder), **self.variables}
        return subprocess.check_output(["bash", "-ec", command], cwd=self.run.folder, env=home, text=True)

    def _of(self, beginnings: Mapping[str, Any], line: str) -> Any:
        """Return the value of the longest beginning of a line, or None, and remember that it was needed."""
        found = max((one for one in beginnings if line.startswith(one)), key=len, default=None)
        if found is None:
            return None
        self._used.add(found)
        return beginnings[found]

    def _as_replaced(self, text: str) -> str:
        for printed, own in self.replaced.items():
            if printed in text:
                self._used.add(printed)
                text = text.replace(printed, own)
        return text

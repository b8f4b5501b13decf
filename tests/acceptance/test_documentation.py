"""Pages of the documentation, compared with the code, and their links."""

import re
import shlex
from pathlib import Path

from docs.generate import ROOT, files
from lint.sources import PACKAGES
from tests.support.named_commands import unknown_options
from tests.support.printed_pages import blocks
from tests.support.who_may import table

from marey_server.process.observe import Metrics

NOT_RUN = {
    "docs/reference/motion-library.md": "generated from docstrings, whose examples tests/unit/motion runs",
    "docs/explanation/datasets-compared.md": "needs three collections of recorded motion",
    "docs/how-to/keep-a-project-in-order.md": "its examples belong to different projects",
    "docs/explanation/twenty-one-walkers.md": "runs a benchmark on recorded motion",
}
"""Pages whose blocks no test runs, each with the reason."""

WRITTEN = sorted([*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")])


def test_the_pages_that_come_from_the_code_are_current() -> None:
    stale = [str(file) for file, text in files().items() if file.read_text(encoding="utf-8") != text]
    assert stale == [], "run `make docs`"


def test_the_threat_model_shows_the_callers_of_the_model() -> None:
    page = (ROOT / "docs" / "explanation" / "threat-model.md").read_text(encoding="utf-8")
    assert table() in page, "copy the table of `tests.support.who_may.table()`"


def test_links_between_pages_lead_somewhere() -> None:
    broken = [
        f"{page.relative_to(ROOT)}: {link}"
        for page in WRITTEN
        for link in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
        if "://" not in link and not (page.parent / link).exists()
    ]
    assert broken == []


def test_the_readme_lists_every_folder_of_the_repository() -> None:
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    hidden_or_generated = (".", "_", "build", "dist", "marey-", "node_modules")
    folders = [one.name for one in ROOT.iterdir() if one.is_dir() and not one.name.startswith(hidden_or_generated)]
    assert not [name for name in folders if f"| `{name}/` |" not in page]


def test_the_architecture_names_every_subpackage() -> None:
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    packages = [ROOT / folder / package for folder, found in PACKAGES.items() for package in found]
    server = ROOT / "server" / "marey_server"
    subpackages = [
        file.parent.name
        for package in (*packages, server / "launchers", server / "store")
        for file in package.glob("*/__init__.py")
    ]
    assert not [name for name in subpackages if f"`{name}/`" not in page]


def test_every_decision_is_listed() -> None:
    listed = (ROOT / "docs" / "decisions" / "README.md").read_text(encoding="utf-8")
    numbered = [file.name for file in (ROOT / "docs" / "decisions").glob("0*.md")]
    assert [name for name in numbered if name not in listed] == []


def test_metrics_that_a_page_names_exist_with_these_labels() -> None:
    page = (ROOT / "docs" / "how-to" / "see-attacks.md").read_text(encoding="utf-8")
    metrics = {
        vars(metric)["_name"]: set(vars(metric)["_labelnames"])
        for metric in vars(Metrics()).values()
        if hasattr(metric, "_labelnames")
    }
    named = re.findall(r"\b(marey_[a-z_]+?)(?:_total)?(?:\{(\w+))?\b", page)
    assert named
    wrong = [name for name, label in named if name not in metrics or (label and label not in metrics[name])]
    assert wrong == []


def named_commands() -> list[tuple[str, str]]:
    """Return (page name, command) for each `marey` command in a shell block or in a sentence of the pages."""
    found = []
    for page in WRITTEN:
        text = page.read_text(encoding="utf-8")
        for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL):
            lines = [line.strip() for line in block.replace("\\\n", " ").splitlines()]
            found += [(page.name, line) for line in lines if line.startswith("marey ")]
        if page.parent.name == "decisions" or page.name == "CHANGELOG.md":
            continue  # their sentences may name commands that were rejected or removed
        sentences = re.sub(r"^ *```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)
        # A group of commands may be named alone, such as `marey dataset`.
        inline = re.findall(r"`(marey\s+[a-z][a-z-]*\s[^`]+)`", sentences)
        found += [(page.name, " ".join(command.split())) for command in inline]
    return found


def test_every_command_that_a_page_names_exists_with_these_options() -> None:
    wrong = []
    for page, line in named_commands():
        words = shlex.split(line.rstrip("&").replace("…", ""), comments=True)[1:]
        try:
            unknown = unknown_options(words)
        except AssertionError as error:
            wrong.append(f"{page}: {line}: {error}")
        else:
            wrong += [f"{page}: {line}: {option}" for option in sorted(unknown)]
    assert wrong == []


def test_a_test_runs_the_blocks_of_each_page() -> None:
    files = [file for file in sorted((ROOT / "tests").rglob("test_*.py")) if file != Path(__file__)]
    tests = "".join(file.read_text(encoding="utf-8") for file in files)
    unnamed = set()
    for page in (one.relative_to(ROOT) for one in WRITTEN):
        joined = '" / "'.join(page.parts)
        if blocks(str(page)) and f'"{page}"' not in tests and f'"{joined}"' not in tests:
            unnamed.add(str(page))
    assert unnamed == NOT_RUN.keys(), "write a test in tests/integration/ways/pages"

"""The documentation says what the code does, and its links lead somewhere."""

import re
from pathlib import Path

import pytest
from docs.generate import REFERENCE, ROOT, pages

WRITTEN = sorted([*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")])


@pytest.mark.parametrize("name", ["command-line.md", "settings.md", "job-kinds.md", "checks.md", "errors.md"])
def test_a_page_that_comes_from_the_code_is_current(name: str) -> None:
    assert (REFERENCE / name).read_text(encoding="utf-8") == pages()[name], "run `make docs`"


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    broken = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert broken == []


def test_every_decision_is_listed() -> None:
    listed = (ROOT / "docs" / "decisions" / "README.md").read_text(encoding="utf-8")
    numbered = [file.name for file in (ROOT / "docs" / "decisions").glob("0*.md")]
    assert [name for name in numbered if name not in listed] == []

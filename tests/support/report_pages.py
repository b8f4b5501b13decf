"""Checks of report pages: valid HTML, expected text, no external resources or scripts."""

import re
from collections import Counter
from html.parser import HTMLParser
from typing import Any

VOID = {"br", "hr", "img", "meta", "col"}
HOSTILE = (
    '<script>alert("1")</script>',
    '"><img src=x onerror=alert(1)>',
    "</style></title>&amp;",
    "\x00\u202egnp",
    "",
)
"""Names that would do harm in a page that does not escape them."""


class Page(HTMLParser):
    """Parsed page: whether its tags are balanced, its text, and the resources and scripts that it would load."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.opened: list[str] = []
        self.tags: Counter[str] = Counter()
        self.ids: Counter[str] = Counter()
        self.links: list[str] = []
        self.attributes: set[str] = set()
        self.words: list[str] = []
        self.scripts: list[str] = []
        self.feed(source)
        self.close()
        assert not self.opened

    def handle_starttag(self, tag: str, attrs: list[tuple[str, Any]]) -> None:
        is_data = tag == "script" and ("type", "application/json") in attrs
        self.tags["script of data" if is_data else tag] += 1
        if tag not in VOID:
            self.opened.append(tag)
        for name, value in attrs:
            self.attributes.add(name)
            if name == "id":
                self.ids[value] += 1
            if name in ("href", "src", "action", "data", "xlink:href"):
                self.links.append(value)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, Any]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.opened.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.opened.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.opened and self.opened[-1] == "script":
            self.scripts.append(data)
        elif self.opened and self.opened[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def is_sound(source: str) -> Page:
    """Check that a page has balanced tags, unique ids, no external resources and one script; return it parsed.

    Scripts of data, which browsers do not run, are not counted.
    """
    page = Page(source)
    assert set(page.ids.values()) == {1}
    for link in page.links:
        assert link.startswith("data:image/png;base64,") or (link.startswith("#") and link[1:] in page.ids)
    assert set(re.findall(r"url\(([^)]*)\)", source)) <= {f"#{name}" for name in page.ids}
    assert not {name for name in page.attributes if name.startswith("on")}
    assert page.tags["script"] == 1
    assert not {"iframe", "object", "embed", "link", "form", "base"} & set(page.tags)
    return page

"""HTML page of a report: one file that contains its style and script, and loads no other file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import NamedTuple

from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.drawing.markup import Content, Html, element, joined
from marey_reports.drawing.paper import COLOURS, HAIRLINE, INK, PAPER, QUIET

# The colours of figures that follow the page's theme.
_THEMED = {
    INK: "var(--ink)",
    QUIET: "var(--quiet)",
    HAIRLINE: "var(--hairline)",
    PAPER: "var(--paper)",
    COLOURS[0]: "var(--first)",
    COLOURS[1]: "var(--second)",
}
_NEEDLESS = re.compile(
    r"<\?xml.*?\?>|<!DOCTYPE.*?>|<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->| xmlns:xlink=\"[^\"]*\"",
    re.DOTALL,
)
_FONTS = re.compile(r"font-family: [^;\"]*;? ?")
_BLANKS = re.compile(r"\s*\n\s*")
_STANDING = re.compile(r" transform=\"rotate\(-?0 [^)]*\)\"")
_REFERENCE = re.compile(r"(?:href=\"|url\()#([^\")]+)")
_ID = re.compile(r" id=\"([^\"]*)\"")


class Section(NamedTuple):
    """Chapter of a report: its anchor, heading and content."""

    anchor: str
    heading: str
    content: Content


def page(title: str, lead: Content, sections: Sequence[Section], ending: Content) -> str:
    """Return a whole HTML document with the given sections."""
    links = [element("li", element("a", section.heading, href=f"#{section.anchor}")) for section in sections]
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        element("title", title),
        element("style", Html(_part("page.css"))),
    )
    body = element(
        "body",
        element("header", element("h1", title), lead),
        element("nav", element("ol", links), aria_label="Contents"),
        element("main", [_section(section) for section in sections]),
        element("footer", ending),
        element("script", Html(_part("page.js"))),
    )
    return f'<!DOCTYPE html>\n<html lang="en">\n{head}\n{body}\n</html>\n'


# Nothing is loaded from anywhere; images within figures are part of the file.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"


def _section(section: Section) -> Html:
    heading = element("h2", section.heading, id=f"{section.anchor}-heading")
    label = f"{section.anchor}-heading"
    return element("section", heading, section.content, id=section.anchor, aria_labelledby=label)


def shown(figures: Mapping[str, DrawnFigure], *names: str) -> Html:
    """Return the HTML of the named figures; names without a figure are skipped."""
    return joined(_shown(figures[name], f"f{list(figures).index(name)}") for name in names if name in figures)


def _shown(figure: DrawnFigure, prefix: str) -> Html:
    picture = element("div", _inline(figure, prefix), tabindex="0", role="group", aria_label=figure.title)
    return element("figure", picture, element("figcaption", element("b", f"{figure.title}. "), figure.caption))


def _inline(figure: DrawnFigure, prefix: str) -> Html:
    """Return a figure's SVG for use in a page: with the page's colours and font, and ids unique in the page."""
    svg = _NEEDLESS.sub("", figure.svg)
    svg = _BLANKS.sub(" ", _STANDING.sub("", _FONTS.sub("", svg))).replace("xlink:href", "href")
    for colour, themed in _THEMED.items():
        svg = svg.replace(colour, themed)
    wanted = set(_REFERENCE.findall(svg))
    svg = _ID.sub(lambda found: f' id="{prefix}{found[1]}"' if found[1] in wanted else "", svg)
    svg = _REFERENCE.sub(lambda found: found[0].replace("#", f"#{prefix}"), svg)
    description = element("desc", figure.caption)
    svg = svg.replace("</title>", f"</title>{description}", 1)
    return Html(svg.replace("<svg ", '<svg role="img" ', 1).strip())


@cache
def _part(name: str) -> str:
    return files("marey_reports.drawing").joinpath(name).read_text(encoding="utf-8")

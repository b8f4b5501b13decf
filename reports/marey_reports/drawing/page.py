"""HTML page of a report: one file that contains its style and script, and loads no other file."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import NamedTuple

from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.drawing.head import ReportHead
from marey_reports.drawing.markup import Content, Html, element, joined
from marey_reports.drawing.paper import COLOURS, HAIRLINE, INK, PAPER, QUIET
from marey_schemas.documents.report_pages import PLAYER_PLACE

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
_WIDTH = re.compile(r"<svg [^>]*?\bwidth=\"([\d.]+pt)\"")
_STANDING = re.compile(r" transform=\"rotate\(-?0 [^)]*\)\"")
_REFERENCE = re.compile(r"(?:href=\"|url\()#([^\")]+)")
_ID = re.compile(r" id=\"([^\"]*)\"")


class Section(NamedTuple):
    """Chapter of a report: its anchor, heading and content."""

    anchor: str
    heading: str
    content: Content


def page(head: ReportHead, lead: Content, sections: Sequence[Section], *, plays_motion: bool = False) -> str:
    """Return a whole HTML document: the head, a summary (`lead`) and the sections.

    With `plays_motion`, the document has a place for the player, which the server inserts when it sends the report.
    """
    links = [element("li", element("a", section.heading, href=f"#{section.anchor}")) for section in sections]
    declared = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        element("title", f"{head.title} – {head.subject}"),
        element("style", Html(_part("page.css"))),
    )
    body = element(
        "body",
        element("header", head.html(), lead),
        element("nav", element("ol", links), aria_label="Contents"),
        element("main", [_section(section) for section in sections]),
        Html(PLAYER_PLACE) if plays_motion else None,
        element("script", Html(_part("page.js"))),
    )
    return f'<!DOCTYPE html>\n<html lang="en">\n{declared}\n{body}\n</html>\n'


def scripts_of(page: str) -> tuple[str, ...]:
    """Return the digest of the script of a page in the syntax of Content-Security-Policy; empty without a script.

    The script is the last `<script>` in the page, because earlier ones can be parts of names of clips.
    """
    _, found, rest = page.rpartition("<script>")
    digest = hashlib.sha256(rest.partition("</script>")[0].encode()).digest()
    return (f"sha256-{base64.b64encode(digest).decode()}",) if found else ()


# Nothing is loaded from anywhere; images within figures are part of the file.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"


def _section(section: Section) -> Html:
    heading = element("h2", section.heading, id=f"{section.anchor}-heading")
    label = f"{section.anchor}-heading"
    return element("section", heading, section.content, id=section.anchor, aria_labelledby=label)


def shown(figures: Mapping[str, DrawnFigure], *names: str) -> Html:
    """Return the HTML of the named figures, whose names are unique in the page; names without a figure are skipped."""
    return joined(_shown(figures[name], _prefix(name)) for name in names if name in figures)


def _prefix(name: str) -> str:
    """Return a beginning of ids for a figure; its name itself may contain signs that ids may not contain."""
    return f"f{hashlib.sha256(name.encode()).hexdigest()[:8]}"


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
    natural = _WIDTH.search(svg)
    style = f' style="--natural: {natural[1]}"' if natural else ""
    return Html(svg.replace("<svg ", f'<svg role="img"{style} ', 1).strip())


@cache
def _part(name: str) -> str:
    return files("marey_reports.drawing").joinpath(name).read_text(encoding="utf-8")

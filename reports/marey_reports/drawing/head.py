"""Head of a report: its subject, the version of Marey that made it, and its inputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from marey_reports.drawing.markup import Html, element, joined
from marey_schemas.documents.report_pages import ORIGIN_PLACE
from marey_schemas.wording import counted

MOST_INPUTS_SHOWN = 3
"""Greatest number of inputs that the head lists at once; longer lists are folded."""


class ReportInput(NamedTuple):
    """Input of a report: its kind in words, its name or path, and the number of its revision."""

    kind: str
    name: str
    revision: int


class ReportHead(NamedTuple):
    """Head of a report.

    Parameters
    ----------
    subject : what the report is, such as "Evaluation of clips"
    title : heading of the page
    code_version : version of Marey that computed the content
    inputs : the revisions that the content was computed from
    """

    subject: str
    title: str
    code_version: str
    inputs: Sequence[ReportInput] = ()

    def html(self) -> Html:
        """Return subject, title and facts; the server inserts project, author and date when it sends the report."""
        facts = [
            _fact("Marey", self.code_version.removeprefix("marey@")),
            *([_inputs(self.inputs)] if self.inputs else []),
        ]
        return joined(
            (
                element("p", self.subject, class_="subject"),
                element("h1", self.title),
                element("dl", Html(ORIGIN_PLACE), facts, class_="origin"),
            )
        )


def _fact(name: str, *content: Html | str) -> Html:
    return element("div", element("dt", name), element("dd", *content))


def _inputs(inputs: Sequence[ReportInput]) -> Html:
    named = [element("li", f"{one.kind} ", element("b", one.name), f", revision {one.revision}") for one in inputs]
    if len(inputs) <= MOST_INPUTS_SHOWN:
        return _fact("inputs", element("ul", named))
    kinds = list(dict.fromkeys(one.kind for one in inputs))
    counts = [counted(sum(one.kind == kind for one in inputs), kind) for kind in kinds]
    folded = element("details", element("summary", ", ".join(counts)), element("ul", named))
    return _fact("inputs", folded)

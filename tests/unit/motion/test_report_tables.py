"""Tables of reports: sentences, names in sentences, and names of limits."""

import re
from pathlib import Path

import pytest
from tests.support.every_report import REPORTS

from marey_reports.drawing.markup import coded
from marey_reports.drawing.tables import LEAST_PROSE, table
from marey_reports.evaluation.definitions import definitions
from marey_schemas.documents.quality import MEASURES
from marey_schemas.options.verdict import VerdictLimits

SENTENCE = "Greatest mean speed of feet in contact, unless `skate_ratio` allows more."


def test_a_name_between_backticks_is_code_and_everything_is_escaped() -> None:
    assert coded("a `b_c` & `<d>`") == "a <code>b_c</code> &amp; <code>&lt;d&gt;</code>"
    assert coded("an odd ` stays") == "an odd ` stays"


def test_a_cell_with_a_sentence_has_a_readable_width_and_no_backticks() -> None:
    made = table("Limits", ("limit", "meaning"), [("skate", SENTENCE), ("lag", "m/s")], numbers=())
    assert '<td class="prose">Greatest mean speed' in made
    assert "unless <code>skate_ratio</code> allows" in made
    assert "<td>m/s</td>" in made
    assert len(SENTENCE) >= LEAST_PROSE


def test_the_definitions_show_names_of_limits_and_measures_as_unbroken_code() -> None:
    page = definitions(VerdictLimits())
    assert '<code class="name">speed_wobble_share</code>' in page
    assert "`" not in page


def test_the_sources_of_quality_measures_name_other_measures_by_their_titles() -> None:
    titles = {measure.title for measure in MEASURES.values()}
    named = [re.search(r"Greatest value of (?:the )?(.*?)(?: in .*)?$", one.source) for one in MEASURES.values()]
    assert {one[1] for one in named if one} <= titles | {"jerk"}
    assert not any("`" in measure.source for measure in MEASURES.values())


@pytest.mark.parametrize("kind", ["quality", "distances"])
def test_units_in_heads_of_columns_are_in_brackets(kind: str, tmp_path: Path) -> None:
    heads = re.findall(r'<th scope="col"[^>]*>([^<]*)</th>', REPORTS[kind](tmp_path))
    assert any(head.endswith(" (s)") for head in heads)
    assert [head for head in heads if head.split()[-1] in {"s", "m", "m/s", "°"}] == []

"""Charts and pages that compare runs: their contents, and harmless display of names and values from scripts."""

from __future__ import annotations

import io
import re
import warnings
from html.parser import HTMLParser
from typing import Any
from xml.etree import ElementTree

import pytest
from matplotlib.image import imread
from tests.support.compared_runs import a_curve, a_run, compared_of
from tests.support.drawn_figures import cut_off

from marey_reports.comparisons import page
from marey_reports.comparisons.axes import axis_title
from marey_reports.comparisons.page import draw_comparison
from marey_reports.comparisons.subjects import ComparedSubject, ends
from marey_schemas.formats.pictures import Plot
from marey_schemas.queue.comparisons import Curve, RunComparison

EVIL = "<script>alert('$x_1$')</script>&\u202e\x1b[31m\n\x00 名前 \U0001f3c3"


def trained() -> RunComparison:
    """Runs with two learning rates and three seeds each, one of which diverges, and with a third rate and one seed."""
    runs, curves = [], {}
    given: list[tuple[float, int, float | str]] = [
        (0.001, 0, 0.5), (0.001, 1, 0.6), (0.001, 2, 0.4), (0.1, 0, 0.9), (0.1, 1, "NaN"), (0.1, 2, 0.8), (10.0, 0, 3.0)
    ]  # fmt: skip
    for number, (rate, seed, loss) in enumerate(given):
        steps = [3.0, 2.0, *([None, None] if isinstance(loss, str) else [1.0, loss])]
        curves[number] = {"loss": a_curve(steps, 10)}
        runs.append(a_run(number, {"rate": rate}, {"loss": loss, "path_m": 2.0 + number}, seed=seed))
    return compared_of(runs, curves, goals={"loss": "lowest"})


def numbers(runs: list[dict[str, Any]]) -> RunComparison:
    """Return a comparison of runs whose only parameter is their number."""
    return compared_of(
        [a_run(number, {"number": number}, fields) for number, fields in enumerate(runs)],
        {number: {"a": a_curve([1.0, one["a"]])} for number, one in enumerate(runs) if isinstance(one.get("a"), float)},
    )


def evil() -> RunComparison:
    runs = [
        a_run(number, {EVIL: f"{number}{EVIL}", "b": True}, {EVIL: 1.0 + number, "<b>": EVIL}, inputs={EVIL: EVIL * 9},
              commit=f"{number}" * 40)
        for number in range(3)
    ]  # fmt: skip
    curves = {number: {EVIL: a_curve([1.0, None, 2.0])} for number in range(3)}
    return compared_of(runs, curves, goals={EVIL: "highest"})


COMPARISONS: dict[str, RunComparison] = {
    "trained": trained(),
    "evil": evil(),
    "one run": numbers([{"a": 0.5}]),
    "equal": numbers([{"a": 1.0}] * 3),
    "zero": numbers([{"a": 0.0}] * 2),
    "huge": numbers([{"a": 1.7e308}, {"a": -1.7e308}, {"a": 1e-300}]),
    "tiny": numbers([{"a": 5e-324}, {"a": 1e-320}]),
    "integers": numbers([{"a": 2**63 - 1}, {"a": -(2**63)}]),
    "many": numbers([{"a": float(number), **{f"f{field}": number for field in range(60)}} for number in range(100)]),
    "no number": numbers([{"a": "x"}, {"b": True}]),
    "one point": compared_of([a_run(0, {}, {"a": 1.0})], {0: {"a": Curve(steps=(7,), values=(1.0,), logged=9)}}),
    "nothing finite": compared_of([a_run(0, {}, {"a": "NaN"})], {0: {"a": a_curve([None, None])}}),
}  # fmt: skip


@pytest.mark.every_nth(3)
@pytest.mark.parametrize("name", COMPARISONS)
def test_each_comparison_has_a_page_and_pictures_with_nothing_cut_off(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = COMPARISONS[name]
    monkeypatch.setattr(page, "MOST_DRAWN", 1)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # the font lacks some letters
        for plot in page.PLOTS:
            subject = ComparedSubject(found, log=True)
            figure = next(page._figures(subject, subject.fields, plot, None), None)
            if figure is not None:
                page._write_caption(figure)
                assert cut_off(figure.sketch.figure) == [], plot
        text = draw_comparison(found, "html", plot="bars").decode()
    assert len(text) < 500_000
    Elements(text).check()


class Elements(HTMLParser):
    """Tags of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        assert not [name for name, _ in attrs if name.startswith("on")]

    def check(self) -> None:
        assert self.tags.count("script") == 1, "only that of the page itself"
        assert self.tags.count("html") == 1


def test_names_and_values_of_scripts_are_escaped_on_pages() -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")
        text = draw_comparison(COMPARISONS["evil"], "html").decode()
    Elements(text).check()
    assert "alert(" in text
    assert "<script>alert" not in text
    assert not re.search("[\x00\x1b\u202e]", text)


def test_a_picture_shows_means_with_n_and_says_which_settings_are_left_out() -> None:
    drawn = draw_comparison(COMPARISONS["trained"], "svg", plot="bars").decode()
    texts = ElementTree.fromstring(drawn).itertext()
    words = " ".join(" ".join(texts).split())
    assert "rate=0.001" in words
    assert "left out, because a run gave no number that can be drawn: (rate=0.1)" in words
    assert "95 % confidence" in words
    assert draw_comparison(COMPARISONS["trained"], "svg", plot="bars").decode() == drawn
    assert imread(io.BytesIO(draw_comparison(COMPARISONS["trained"], "png", plot="lines"))).shape[1] > 1000


def test_a_mean_curve_ends_where_a_run_has_no_number() -> None:
    subject = ComparedSubject(COMPARISONS["trained"], log=False)
    figure = next(page._figures(subject, subject.fields, "lines", None))
    table = figure.data["tables"]["means"]
    steps = {name: [step for own, step in zip(table["setting"], table["step"], strict=True) if own == name]
             for name in table["setting"]}  # fmt: skip
    assert steps == {"rate=0.001": [0, 10, 20, 30], "rate=10": [0, 10, 20, 30], "rate=0.1": [0, 10]}
    assert set(table["n"]) == {1, 3}


def test_the_page_says_whether_the_best_setting_is_apart_from_the_others() -> None:
    text = draw_comparison(COMPARISONS["trained"], "html").decode()
    assert "With fewer than 3 seeds, chance may explain" in text
    assert re.findall("<h2[^>]*>([^<]*)<", text) == ["Over steps", "By parameter", "By setting", "Means", "Runs"]
    for shift, says in ((9.0, False), (0.01, True)):
        runs = [
            a_run(3 * group + seed, {"size": group}, {"score": shift * group + 0.1 * seed}, seed=seed)
            for group in range(2)
            for seed in range(3)
        ]
        text = draw_comparison(compared_of(runs, sort="-fields.score"), "html", plot="bars").decode()
        assert "size=1 has the highest score" in text
        assert ("overlaps that of another setting" in text) == says


WITHOUT_VALUES: list[tuple[str, Plot | None, str]] = [
    ("no number", None, "no numbers for a chart"),
    ("integers", "lines", "no compared field was logged"),
    ("one run", "scatter", "no parameter"),
]


def test_a_chart_without_values_is_refused() -> None:
    for name, plot, reason in WITHOUT_VALUES:
        with pytest.raises(ValueError, match=reason):
            draw_comparison(COMPARISONS[name], "svg", plot=plot)
    with pytest.raises(ValueError, match="no parameter 'x'; they have rate"):
        draw_comparison(COMPARISONS["trained"], "svg", plot="scatter", parameter="x")


def test_units_in_names_are_written_on_axes() -> None:
    assert [axis_title(name) for name in ("path_m", "mean_error_deg", "loss", "m", "size_of_x", "a_s")] == [
        "path (m)", "mean error (°)", "loss", "m", "size_of_x", "a (s)",
    ]  # fmt: skip
    assert axis_title("path_m", log=True) == "path (m), logarithmic"


def test_an_interval_has_three_digits_of_its_width() -> None:
    intervals = [(0.35648, 0.50552), (-1.4841, 3.4841), (-0.0001, 0.9), (1000.2, 1900.8), (2.0, 2.0), (1e-9, 3e-9)]
    assert [ends(low, high) for low, high in intervals] == [
        "0.356 to 0.506", "-1.48 to 3.48", "0.000 to 0.900", "1000.2 to 1900.8", "2 to 2", "1e-09 to 3e-09",
    ]  # fmt: skip

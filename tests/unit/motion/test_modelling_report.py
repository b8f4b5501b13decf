"""Reports of models: one valid HTML file with the learned values, for any names of clips."""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from tests.support.drawn_models import DRAWN_MODELS, figures_of, figures_of_walks, model_of_walks, trained_on
from tests.support.model_examples import walks
from tests.support.report_pages import HOSTILE, Page, is_sound
from tests.support.tiers import is_soak

from marey_motion.alignment.aligned import Recording
from marey_motion.modelling.training import TrainedPrimitive
from marey_motion.modelling.training_warnings import ModelWarning
from marey_motion.modelling.verdict import verdict_of
from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.models.figures import ModelSubject, draw_alignment_figures, draw_model_figures
from marey_reports.models.figures.spectrum import draw_reconstruction
from marey_reports.models.page import render_model_report
from marey_schemas.options.modelling import ModelOptions

ORIGIN = {
    "aligned": [{"item": "item_1", "revision": 2, "name": "lab/aligned/walk 00"}],
    "set": "sha256:abc",
    "reference": "walk000",
    "seed": 7,
}


pytestmark = DRAWN_MODELS


def rendered(
    trained: TrainedPrimitive, subject: ModelSubject, figures: Mapping[str, DrawnFigure] | None = None, **options: Any
) -> str:
    return render_model_report(trained, subject, figures or {}, **dict[str, Any](title="Walk", origin=ORIGIN) | options)


@pytest.fixture(scope="module")
def model() -> tuple[TrainedPrimitive, ModelSubject]:
    return model_of_walks()


@pytest.fixture(scope="module")
def figures() -> Mapping[str, DrawnFigure]:
    return figures_of_walks()


@pytest.fixture(scope="module")
def page(model: tuple[TrainedPrimitive, ModelSubject], figures: Mapping[str, DrawnFigure]) -> Page:
    return is_sound(rendered(model[0], model[1], figures))


def test_a_report_is_one_sound_file_that_shows_every_figure(page: Page, figures: Mapping[str, DrawnFigure]) -> None:
    assert page.tags["svg"] == page.tags["figcaption"] == len(figures)
    assert page.tags["h1"] == 1
    for figure in figures.values():
        assert figure.caption in page.text


def test_the_page_opens_with_the_verdict(page: Page, model: tuple[TrainedPrimitive, ModelSubject]) -> None:
    before, verdict, _ = page.text.partition(verdict_of(model[0]))
    assert verdict
    assert re.fullmatch(r"Walk – Model of motion Model of motion Walk Marey [\d.]+ ", before)


def test_the_same_model_gives_the_same_page(
    model: tuple[TrainedPrimitive, ModelSubject], figures: Mapping[str, DrawnFigure]
) -> None:
    assert rendered(model[0], model[1], figures) == rendered(model[0], model[1], figures)


def test_the_page_may_load_nothing(model: tuple[TrainedPrimitive, ModelSubject]) -> None:
    assert "default-src &#39;none&#39;" in rendered(*model)
    assert not re.search(r"(?:href|src)=\"(?!#|data:)", rendered(*model))


def test_the_numbers_of_every_example_are_listed(page: Page, model: tuple[TrainedPrimitive, ModelSubject]) -> None:
    for example in model[0].report.examples:
        assert f"{example.duration_s:.2f}" in page.text
        assert f"{example.left_out_error_cm:.1f}" in page.text


def test_every_number_of_samples_and_examples_is_in_a_column_of_numbers(
    model: tuple[TrainedPrimitive, ModelSubject],
) -> None:
    trained, subject = model
    report = replace(subject.report, held_out_low_share=0.08, held_out_subject_low_share=0.12)
    page = rendered(trained, replace(subject, report=report))
    rows = re.findall(r"<tr><th[^>]*>less likely than 95 %[^<]*unseen (\w+)[^<]*</th>(.*?)</tr>", page)
    assert [(whose, re.findall(r'<td class="number"[^>]*>(\d+)</td>', cells)) for whose, cells in rows] == [
        ("takes", ["5", "8"]), ("performers", ["5", "12"])
    ]  # fmt: skip


def test_warnings_are_told_first_and_with_their_codes(model: tuple[TrainedPrimitive, ModelSubject]) -> None:
    trained, subject = model
    warned = replace(trained, warnings=(ModelWarning("odd-durations", "half of the samples <last> longer"),))
    text = is_sound(rendered(warned, subject)).text
    assert "Half of the samples <last> longer. odd-durations" in text
    assert "There are no warnings." in is_sound(rendered(replace(trained, warnings=()), subject)).text


def test_it_says_what_the_model_was_made_of(page: Page) -> None:
    assert "item_1@2" in page.text
    assert "lab/aligned/walk 00" in page.text
    assert "left foot down" in page.text
    assert "jacobian" in page.text


def test_names_and_titles_are_shown_and_never_run() -> None:
    trained, subject = trained_on(walks(6, names=(*HOSTILE, "plain")))
    figures = figures_of(subject) if is_soak() else draw_alignment_figures(subject.examples)
    page = is_sound(rendered(trained, subject, figures, title=HOSTILE[1]))
    assert HOSTILE[0] in page.text
    assert "alert" not in "".join(page.scripts)


@pytest.mark.parametrize("odd", ["copies", "bare"])
def test_models_of_little_are_reported(odd: str) -> None:
    aligned = walks(3)
    if odd == "copies":
        first = aligned.clips[0]
        aligned = replace(aligned, clips=tuple(replace(first, uid=f"walk00{n}") for n in range(3)), keyframes={})
    options = ModelOptions(leave_one_out=False, folds=0, report_samples=0, starts=1)
    trained, subject = trained_on(aligned, options)
    page = is_sound(rendered(trained, subject, draw_model_figures(subject) if is_soak() else None, origin={}))
    assert "not measured" in page.text
    assert ("all examples are the same motion" in page.text) is (odd == "copies")


def test_one_take_is_said_to_tell_nothing_of_others() -> None:
    aligned = walks(6)
    clips = tuple(replace(clip, recording=Recording("take 1")) for clip in aligned.clips)
    trained, subject = trained_on(replace(aligned, clips=clips))
    drawn = draw_reconstruction(subject)
    assert drawn is not None
    assert "that of other takes is unknown, because all examples come from one take." in drawn.caption
    assert list(drawn.tables["errors"]) == ["components", "training_cm"]
    text = is_sound(rendered(trained, subject)).text
    assert "unknown: all examples come from one take; of a training example: " in text

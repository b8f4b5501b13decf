"""Defects of suggested clips beside those of the set."""

from dataclasses import replace

import pytest

from marey_motion.evaluation.improvement.defects import COMPARED, Defects, Excess, compare_defects
from marey_motion.evaluation.improvement.filling import Addition, FilledCell, Filling
from marey_motion.evaluation.improvement.reasons import why_addition, why_filling, why_look
from marey_schemas.documents.quality import MEASURES

FILLING = Filling("runs", "a@1", "a", 4.0, (FilledCell(1.5, 0.0, 0.9, 1.0),), 1.0, 0.25, 40, False, 0.25, 0.5)


def measured(**values: float | None) -> dict[str, float | None]:
    """Measures of a clip without defects, but for the given ones."""
    return {**dict.fromkeys(MEASURES, 0.0), **values}


def test_less_is_better_in_all_measures_that_are_compared() -> None:
    assert {MEASURES[name].better for name in COMPARED} == {"less"}


def test_only_what_is_far_beyond_the_worst_clip_of_the_set_is_named() -> None:
    of_set = [measured(penetration_max_m=0.02), measured(penetration_max_m=0.05, jerk_peak_m_s3=400.0)]
    found = compare_defects(measured(penetration_max_m=0.11, jerk_peak_m_s3=900.0, jitter_m_s3=9e9), of_set)
    assert found.excesses == (Excess("penetration_max_m", 0.11, 0.05),)
    assert found.compared == 2
    assert found.values["jitter_m_s3"] == 9e9


@pytest.mark.parametrize(("name", "least"), COMPARED.items())
def test_a_measure_counts_beyond_twice_the_greatest_and_beyond_a_least_difference(name: str, least: float) -> None:
    def counts(value: float, greatest: float) -> bool:
        return bool(compare_defects(measured(**{name: value}), [measured(**{name: greatest}), measured()]).excesses)

    assert counts(1.01 * least, 0.0)
    assert not counts(0.99 * least, 0.0)
    assert counts(20.1 * least, 10.0 * least)
    assert not counts(19.9 * least, 10.0 * least)


@pytest.mark.parametrize(("value", "of_set"), [(None, 0.1), (0.5, None)])
def test_a_measure_that_is_undefined_on_one_side_is_not_compared(value: float | None, of_set: float | None) -> None:
    found = compare_defects(measured(limit_excess_max_deg=value), [measured(limit_excess_max_deg=of_set)])
    assert found.excesses == ()


WORSE = compare_defects(measured(skate_weighted_m_s=0.31, jerk_peak_m_s3=12_345.6), [measured(skate_weighted_m_s=0.12)])


def test_the_reason_for_a_filling_names_its_far_greater_defects() -> None:
    assert why_filling(FILLING, WORSE) == (
        f"{why_filling(FILLING)} Look at it before you add it: foot skate, weighted by height: 0.310 m/s, in the set "
        "up to 0.120; greatest jerk: 12,346 m/s³, in the set up to 0."
    )
    assert why_filling(FILLING, compare_defects(measured(), [measured()])) == why_filling(FILLING)


def test_the_order_in_which_to_add_clips_repeats_which_ones_to_look_at() -> None:
    addition = Addition(FILLING, 1.0, 0.25)
    said = why_addition(addition)
    assert why_addition(addition, WORSE) == f"{said} Look at it first, because of its defects."
    assert why_addition(addition, compare_defects(measured(), [measured()])) == said


def test_the_reason_for_a_filling_that_cannot_be_measured_says_why() -> None:
    defects = Defects({}, problem="it has 3 frames")
    assert why_filling(FILLING, defects).endswith("with the set. Its quality was not measured: it has 3 frames.")


@pytest.mark.parametrize(
    ("defects", "said"),
    [
        ({}, ""),
        (
            {"a": compare_defects(measured(), [measured()] * 3), "b": Defects({}, problem="it has 3 frames")},
            "The quality of 1 clip was compared with that of the set (3 clips): none of them has defects that are far "
            "greater.",
        ),
        (
            dict.fromkeys("abcdefgh", WORSE),
            "The quality of 8 clips was compared with that of the set (1 clip): look at “a”, “b”, “c”, “d”, “e” and 3 "
            "more before you add them, because of far greater defects.",
        ),
        (
            {"a": WORSE, "b": compare_defects(measured(), [measured()])},
            "The quality of 2 clips was compared with that of the set (1 clip): look at “a” before you add it, because "
            "of far greater defects.",
        ),
        (
            {"a": compare_defects(measured(), [])},
            "No clip of the set could be measured, so their quality was not compared with that of the set.",
        ),
        (
            {"a": Defects({}, problem="it has 3 frames")},
            "None of them could be measured, so their quality was not compared with that of the set.",
        ),
    ],
)
def test_clips_to_look_at_are_named_together(defects: dict[str, Defects], said: str) -> None:
    fillings = [replace(FILLING, source=name, name=name) for name in "abcdefgh"]
    assert why_look(fillings, defects) == said


def test_without_measures_the_reason_speaks_of_the_gain_alone() -> None:
    assert why_filling(replace(FILLING, needs_retarget=True)).endswith("must be retargeted first.")

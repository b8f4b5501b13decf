from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.support.evaluation_cases import arc, root_database

from marey_motion.errors import MotionError
from marey_motion.evaluation.provenance import _CONDITION_OF, provenance_of, require_comparable
from marey_motion.evaluation.result import Provenance
from marey_motion.evaluation.scenario import suite_trials
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.matching import ControllerOptions, DatabaseOptions, FeatureWeights

OPTIONS = EvaluationOptions(speeds_m_s=(1.0, 2.0), turn_rates_deg_s=(-50.0, 50.0))
LEFT, RIGHT = arc(1.0, 50.0, 2.0), arc(2.0, -50.0, 2.0)


def traced(*roots: Any, options: EvaluationOptions = OPTIONS, **changes: Any) -> Provenance:
    database = root_database(*roots, options=options.database)
    return provenance_of(replace(database, **changes), options, suite_trials(options))


def test_equal_data_and_options_have_equal_digests() -> None:
    assert traced(LEFT, RIGHT) == traced(LEFT, RIGHT)


def test_a_data_set_is_named_by_its_motion_not_by_the_ids_of_its_clips() -> None:
    here = traced(LEFT, RIGHT)
    clips = root_database(LEFT, RIGHT).clips
    renamed = tuple(replace(clip, uid=f"other-{clip.uid}", name="other") for clip in clips)

    assert traced(LEFT, RIGHT, clips=renamed).dataset == here.dataset
    assert traced(RIGHT, LEFT).dataset == here.dataset
    assert traced(LEFT, arc(2.0, -50.0, 2.1)).dataset != here.dataset
    assert traced(LEFT).dataset != here.dataset
    assert traced(LEFT, LEFT).dataset != traced(LEFT).dataset


def test_clips_are_traced_to_the_documents_they_came_from_where_these_are_known() -> None:
    first, second = root_database(LEFT, RIGHT).clips
    found = traced(LEFT, RIGHT, clips=(replace(first, content="sha256:abc"), second)).clips

    assert found["a"] == "sha256:abc"
    assert found["b"].startswith("sha256:")
    assert len(found["b"]) == len("sha256:") + 64


def test_a_whole_number_is_the_same_option_however_it_is_written() -> None:
    whole = OPTIONS.replace(
        approach_s=3, speeds_m_s=(1, 2), turn_rates_deg_s=(-50, 50), controller=ControllerOptions(switch_margin=0)
    )
    decimal = OPTIONS.replace(controller=ControllerOptions(switch_margin=-0.0))

    assert traced(LEFT, options=whole) == traced(LEFT, options=decimal)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (OPTIONS.replace(controller=ControllerOptions(follow="path")), "options"),
        (OPTIONS.replace(database=DatabaseOptions(weights=FeatureWeights(hip_velocity=2.0))), "options"),
        (OPTIONS.replace(window="all"), "options"),
        (OPTIONS.replace(duration_s=10.0), "scenarios"),
        (OPTIONS.replace(speeds_m_s=(1.0,), turn_rates_deg_s=(50.0,)), "scenarios"),
        (OPTIONS.replace(families=("circle",)), "scenarios"),
    ],
)
def test_evaluations_under_other_conditions_are_not_compared(options: EvaluationOptions, named: str) -> None:
    with pytest.raises(MotionError, match=f"their {named} differ") as refused:
        require_comparable(traced(LEFT), traced(LEFT, options=options))
    assert refused.value.code == "not-comparable"
    assert refused.value.where == named


def test_evaluations_with_other_normalisers_are_not_compared_and_the_message_says_what_to_do() -> None:
    plain = root_database(LEFT)
    other = replace(plain.normaliser, scale=np.full(27, 2.0))
    with pytest.raises(MotionError, match=r"their normalisers differ .*pinned"):
        require_comparable(traced(LEFT), traced(LEFT, normaliser=other))


def test_all_that_differs_is_named_at_once() -> None:
    with pytest.raises(MotionError, match=r"options differ.*scenarios differ"):
        require_comparable(traced(LEFT), traced(LEFT, options=OPTIONS.replace(window="all", duration_s=10.0)))


@pytest.mark.parametrize("options", [OPTIONS.replace(coverage_least_s=5.0), OPTIONS.replace(literal_formulas=True)])
def test_other_data_and_what_no_trial_depends_on_may_differ(options: EvaluationOptions) -> None:
    require_comparable(traced(LEFT), traced(RIGHT, options=options))


def test_every_option_belongs_to_a_condition_of_comparisons_or_is_known_to_change_no_compared_number() -> None:
    without_condition = {"coverage_least_s", "literal_formulas"}
    assert _CONDITION_OF.keys() | without_condition == EvaluationOptions.model_fields.keys()
    assert not _CONDITION_OF.keys() & without_condition
    for other in (OPTIONS.replace(coverage_least_s=2.0), OPTIONS.replace(literal_formulas=True)):
        require_comparable(traced(LEFT), traced(LEFT, options=other))

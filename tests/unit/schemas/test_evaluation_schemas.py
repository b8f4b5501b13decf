"""Parameters of evaluations, and the division of trials into tasks."""

from typing import Any

import pytest
from pydantic import ValidationError

from marey_schemas.queue.job_params import MOST_EVALUATION_TASKS, MOST_TRIALS, EvaluateParams, count_evaluation_tasks


def test_the_defaults_are_the_published_suite() -> None:
    params = EvaluateParams()
    assert params.trial_count == 162
    assert (params.speeds_m_s[0], params.speeds_m_s[-1]) == (1.0, 3.0)
    assert (params.turn_rates_deg_s[0], params.turn_rates_deg_s[-1]) == (-100.0, 100.0)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"speeds_m_s": []}, "at least 1"),
        ({"speeds_m_s": [0]}, "greater than 0"),
        ({"speeds_m_s": [float("nan")]}, "finite|greater"),
        ({"speeds_m_s": [1, 1]}, "contains a value twice"),
        ({"turn_rates_deg_s": [721]}, "less than or equal to 720"),
        ({"duration_s": 601}, "less than or equal to 600"),
        ({"speeds_m_s": [0.1 * n for n in range(1, 41)], "turn_rates_deg_s": list(range(40))}, "3200 trials"),
        ({"speeds_m_s": [0.1 * n for n in range(1, 31)], "turn_rates_deg_s": list(range(30)), "duration_s": 600},
         "1800 trials of this length"),
        ({"trims": {"clip_1": [5, 5]}}, "must be after"),
        ({"database": {"mirroring": "sometimes"}}, "none"),
        ({"controler": {}}, "Extra inputs"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_or_takes_too_long_is_refused(options: dict[str, Any], told: str) -> None:
    with pytest.raises(ValidationError, match=told):
        EvaluateParams.model_validate(options)


def test_a_few_trials_make_one_task_and_many_no_more_than_so_many() -> None:
    few = EvaluateParams(speeds_m_s=(1.0,), turn_rates_deg_s=(0.0, 25.0), families=("circle",))
    most = EvaluateParams(
        speeds_m_s=tuple(0.1 * n for n in range(1, 41)),
        turn_rates_deg_s=tuple(float(n) for n in range(25)),
        families=("circle", "switching"),
    )
    assert count_evaluation_tasks(few) == 1
    assert count_evaluation_tasks(EvaluateParams()) == 21
    assert most.trial_count == MOST_TRIALS
    assert count_evaluation_tasks(most) <= MOST_EVALUATION_TASKS

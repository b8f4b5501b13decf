"""Parameters of comparisons, suggestions, optimisations and sweeps."""

from typing import Any

import pytest
from pydantic import ValidationError

from marey_schemas.options.improvement import ObjectiveOptions
from marey_schemas.queue.job_kinds import MOST_TASKS, find_kind
from marey_schemas.queue.job_params import OptimiseParams, SuggestParams, SweepParams, count_sweep_tasks


def test_a_sweep_has_a_task_for_every_setting_and_never_too_many() -> None:
    assert count_sweep_tasks(SweepParams()) == 15
    assert count_sweep_tasks(SweepParams(factors=tuple(float(n) for n in range(20)))) <= MOST_TASKS


@pytest.mark.parametrize(
    ("params", "given"),
    [
        (ObjectiveOptions, {"offset": -1}),
        (ObjectiveOptions, {"seconds": float("nan")}),
        (OptimiseParams, {"max_steps": 0}),
        (SuggestParams, {"removals": 1001}),
        (SweepParams, {"factors": ()}),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_name(params: Any, given: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=next(iter(given))):
        params.model_validate(given)


@pytest.mark.parametrize("kind", ["compare", "suggest", "optimise", "sweep"])
def test_every_parameter_is_described(kind: str) -> None:
    for name, field in find_kind(kind).params.model_fields.items():
        assert field.description or name == "objective"

"""Documents of pipelines: the order of the steps, and the inputs of each step."""

from typing import Any

import pytest
from pydantic import ValidationError

from marey_schemas.queue.pipelines import MOST_STEPS, PipelineCreate, PipelineError, job_of_step, order_steps


def pipeline(steps: dict[str, Any], **shared: Any) -> PipelineCreate:
    full = {name: {"kind": "retarget", **step} for name, step in steps.items()}
    return PipelineCreate.model_validate({"steps": full, **shared})


def takes(*steps: str) -> dict[str, Any]:
    return {"inputs": {"clips": [{"step": step} for step in steps]}}


def test_each_step_comes_after_those_it_needs_and_else_as_given() -> None:
    made = pipeline({"model": takes("align"), "align": takes("b", "a"), "b": {}, "a": {}, "last": {"after": ["model"]}})
    assert order_steps(made) == ("b", "a", "align", "model", "last")


@pytest.mark.parametrize(
    ("steps", "pointer", "code"),
    [
        ({"a": takes("b")}, "/steps/a/inputs/clips/0/step", "unknown-step"),
        ({"a": {"inputs": {"clips": {"step": "b"}}}}, "/steps/a/inputs/clips/step", "unknown-step"),
        ({"a": {"after": ["b"]}}, "/steps/a/after/0", "unknown-step"),
        ({"a": takes("a")}, "/steps/a/inputs/clips/0/step", "cycle"),
        ({"a": {"after": ["b"]}, "b": {"after": ["a"]}}, "/steps/b/after/0", "cycle"),
    ],
)
def test_steps_that_make_no_sense_together_are_refused_with_their_place(
    steps: dict[str, Any], pointer: str, code: str
) -> None:
    with pytest.raises(PipelineError) as refused:
        order_steps(pipeline(steps))
    assert (refused.value.pointer, refused.value.code) == (pointer, code)


def test_a_circle_is_told_step_by_step() -> None:
    with pytest.raises(PipelineError, match="wait for each other"):
        order_steps(pipeline({"a": takes("c"), "b": takes("a"), "c": takes("b"), "d": {}}))


def test_a_step_is_as_the_pipeline_says_where_it_says_nothing_itself() -> None:
    made = pipeline(
        {"first": {"into": "own", "seed": 3}, "second": takes("first")}, into="shared", seed=7, priority=2, cache="off"
    )
    first = job_of_step(made, "first", {})
    second = job_of_step(made, "second", {"first": "job_1"})
    assert (first.into, first.seed, first.priority, first.cache) == ("own", 3, 2, "off")
    assert (second.into, second.seed, second.model_dump()["inputs"]) == ("shared", 7, {"clips": ({"job": "job_1"},)})


def test_more_steps_than_can_be_are_refused() -> None:
    pipeline({f"step{n}": {} for n in range(MOST_STEPS)})
    with pytest.raises(ValidationError):
        pipeline({f"step{n}": {} for n in range(MOST_STEPS + 1)})

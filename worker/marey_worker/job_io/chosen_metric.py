"""Perceptual metric of a job: a built-in one that a parameter names, or a stored one that is an input."""

from __future__ import annotations

from marey_schemas.documents.metrics import MetricDocument, built_in_metric
from marey_schemas.kinds import Kind
from marey_schemas.options.perception import DEFAULT_METRIC
from marey_worker.context import Context, JobRefused


def read_metric(context: Context, name: str | None) -> MetricDocument | None:
    """Return the perceptual metric that the job uses, or None if it uses none.

    `name` is the parameter `metric` of the job. Raises `JobRefused` if the job has both this parameter and an input
    `metric`.
    """
    (pin,) = context.inputs.get("metric", ()) or (None,)
    if pin is None:
        return None if name is None else built_in_metric(name)
    if name is not None:
        raise JobRefused(
            "two-metrics",
            f"the parameter metric names {name}, and the input metric is {pin.path}; give only one of the two",
        )
    return MetricDocument.model_validate(context.document(Kind.METRIC, pin.item, pin.revision, "metric"))


def read_metric_or_default(context: Context, name: str | None) -> MetricDocument:
    """Return the perceptual metric that the job uses: its parameter or input `metric`, or else `DEFAULT_METRIC`."""
    return read_metric(context, name) or built_in_metric(DEFAULT_METRIC)

"""Perceptual metrics, and the distances of clips that they give."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from marey_client.blobs import Blobs
from marey_client.handles.findings import Findings
from marey_client.items import ItemHandle, Items
from marey_schemas.documents.metrics import MetricDocument, built_in_metric, is_built_in
from marey_schemas.queue.jobs import ItemInput


class MetricHandle(ItemHandle):
    """Handle of a perceptual metric."""

    def document(self, *, revision: int | None = None) -> MetricDocument:
        """Return weights, conventions and origin of the metric."""
        return MetricDocument.model_validate(self.part("metric", revision=revision))


Metric: TypeAlias = MetricHandle | str
"""A stored metric, its id, or the name of a built-in metric such as `published/sigmoid`."""


class PerceptualMetrics(Items[MetricHandle]):
    """The perceptual metrics of a project."""

    def store(self, metric: MetricDocument | str, name: str, *, collection: str = "") -> MetricHandle:
        """Store a metric, or the built-in one with this name, as an item, so that versions of datasets can contain it.

        Raises `KeyError` if no built-in metric has the name, and `Conflict` if an item has it.
        """
        document = built_in_metric(metric) if isinstance(metric, str) else metric
        return self.create(name, {"metric": document.stored()}, collection=collection)


def metric_choice(metric: Metric | None) -> tuple[dict[str, ItemInput], dict[str, Any]]:
    """Return the input and the parameter of a job that name a metric; without a metric, both are empty."""
    if metric is None:
        return {}, {}
    if isinstance(metric, str):
        return ({}, {"metric": metric}) if is_built_in(metric) else ({"metric": ItemInput(item=metric)}, {})
    return {"metric": metric.as_input()}, {}


@dataclass(frozen=True)
class Distances(Findings):
    """Perceptual distances of clips."""

    def table(self) -> NDArray[np.float64]:
        """Return the distances (N, N) of all pairs, in the order of the document's `clips`."""
        return np.asarray(self.document()["distances"])

    def maps(self) -> dict[str, NDArray[Any]]:
        """Return motion maps and registration curves of the drawn pairs: the only pair, or nearest and farthest.

        The names begin with `pair0_` or `pair1_`. They end with the measurement or `combined` for maps, with frames of
        the first clip as rows; with `map_rate_hz` for the frame rate of rows and columns; and with `curve_first_s` and
        `curve_second_s` for the times at which both clips show the same moment.
        """
        with np.load(io.BytesIO(Blobs(self.transport).fetch(self._blob("maps")))) as arrays:
            return dict(arrays)

    def save_maps(self, path: str | Path) -> Path:
        """Write the arrays of `maps` to a file, as a NumPy archive; return the path."""
        return Blobs(self.transport).fetch_to(self._blob("maps"), Path(path))

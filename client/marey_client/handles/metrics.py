"""Handles of perceptual metrics, and of distances between clips that a job has measured by one."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from marey_client.arguments import checks_arguments
from marey_client.blobs import Blobs
from marey_client.handles.findings import Findings
from marey_client.items import ItemHandle, Items
from marey_schemas.documents.metrics import MetricDocument, built_in_metric, is_built_in
from marey_schemas.queue.jobs import ItemInput


@checks_arguments
class MetricHandle(ItemHandle):
    """Handle of a stored perceptual metric."""

    def document(self, *, revision: int | None = None) -> MetricDocument:
        """Return weights, conventions and origin of the metric."""
        return MetricDocument.model_validate(self.part("metric", revision=revision))


Metric: TypeAlias = MetricHandle | str
"""A stored metric, its id, or the name of a built-in metric such as `published/sigmoid`."""


@checks_arguments
class PerceptualMetrics(Items[MetricHandle]):
    """Stored perceptual metrics of a project."""

    def store(self, metric: MetricDocument | str, name: str, *, collection: str = "") -> MetricHandle:
        """Store a metric as an item, so that versions of datasets can contain the metric.

        `metric` is a document or the name of a built-in metric; `name` is the name of the item. Raises `KeyError` if
        there is no such built-in metric, and `Conflict` if an item has the name.
        """
        document = built_in_metric(metric) if isinstance(metric, str) else metric
        return self.create(name, {"metric": document.stored()}, collection=collection)


def metric_choice(metric: Metric | None) -> tuple[dict[str, ItemInput], dict[str, Any]]:
    """Return the inputs and the parameters with which a job uses a metric; both are empty if `metric` is None."""
    if metric is None:
        return {}, {}
    if isinstance(metric, str):
        return ({}, {"metric": metric}) if is_built_in(metric) else ({"metric": ItemInput(item=metric)}, {})
    return {"metric": metric.as_input()}, {}


@dataclass(frozen=True)
class Distances(Findings):
    """Result of a job of the kind `distances`: perceptual distances between clips."""

    def table(self) -> NDArray[np.float64]:
        """Return the distances (N, N) of all pairs, in the order of the document's `clips`."""
        return np.asarray(self.document()["distances"])

    def maps(self) -> dict[str, NDArray[Any]]:
        """Return the motion maps and registration curves of the only pair, or of the nearest and the farthest pair.

        The result maps names to arrays. The names begin with `pair0_` or `pair1_`, and end as follows:

        * the measurement, or `combined`: a map; rows are frames of the first clip, columns frames of the second clip
        * `map_rate_hz`: frame rate of the rows and columns of the maps
        * `curve_first_s`, `curve_second_s`: times in seconds at which the two clips show the same moment
        """
        with np.load(io.BytesIO(Blobs(self.transport).fetch(self._blob("maps")))) as arrays:
            return dict(arrays)

    def save_maps(self, path: str | Path) -> Path:
        """Write the arrays of `maps` to a file, as a NumPy archive; return the path."""
        return Blobs(self.transport).fetch_to(self._blob("maps"), Path(path))

"""Counterparts of `marey_client.handles.metrics` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from typing import TypeAlias

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.items import AsyncItemHandle, AsyncItems
from marey_client.handles.metrics import MetricHandle, PerceptualMetrics
from marey_schemas.documents.metrics import MetricDocument


@counterpart_of(MetricHandle)
class AsyncMetricHandle(AsyncItemHandle):
    """Handle of a stored perceptual metric."""

    _sync: MetricHandle

    async def document(self, *, revision: int | None = None) -> MetricDocument:
        """Return weights, conventions and origin of the metric."""
        return await self._run(self._sync.document, revision=revision)


AsyncMetric: TypeAlias = AsyncMetricHandle | str


@counterpart_of(PerceptualMetrics)
class AsyncPerceptualMetrics(AsyncItems[AsyncMetricHandle]):
    """Stored perceptual metrics of a project."""

    _sync: PerceptualMetrics

    async def store(self, metric: MetricDocument | str, name: str, *, collection: str = "") -> AsyncMetricHandle:
        """Store a metric as an item, so that versions of datasets can contain the metric.

        `metric` is a document or the name of a built-in metric; `name` is the name of the item. Raises `KeyError` if
        there is no such built-in metric, and `Conflict` if an item has the name.
        """
        exchanged: AsyncMetricHandle = await self._exchange(self._sync.store, metric, name, collection=collection)
        return exchanged

"""Counterparts of `marey_client.handles.evaluations` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Unpack

from numpy.typing import NDArray

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.handles.clips import AsyncClipHandle
from marey_client.asynchronous.handles.findings import AsyncFindings
from marey_client.asynchronous.handles.metrics import AsyncMetric
from marey_client.asynchronous.handles.reports import AsyncReportedHandle
from marey_client.asynchronous.jobs import AsyncOnProgress
from marey_client.asynchronous.places import AsyncPlaces
from marey_client.handles.evaluations import EvaluationHandle
from marey_client.keywords.evaluation import CompareKeywords, OptimiseKeywords, SuggestKeywords, SweepKeywords
from marey_schemas.queue.jobs import JobCreate


@counterpart_of(EvaluationHandle)
class AsyncEvaluationHandle(AsyncReportedHandle):
    """Handle of an evaluation of locomotion clips: trials, use of the clips, report, and jobs to improve the clips."""

    _sync: EvaluationHandle

    async def document(self, *, revision: int | None = None) -> dict[str, Any]:
        """Return options, provenance, metrics, usage and coverage of the evaluation, without the record of each tick.

        Arrays are numpy arrays.
        """
        return await self._run(self._sync.document, revision=revision)

    async def trials(self) -> list[dict[str, Any]]:
        """Return one row per trial: name, requested motion, verdict, and metrics."""
        return await self._run(self._sync.trials)

    async def worst_trials(self) -> list[dict[str, Any]]:
        """Return the rows of `trials` from the worst trial to the best, in the order of the report."""
        return await self._run(self._sync.worst_trials)

    async def clips(self) -> list[dict[str, Any]]:
        """Return one row per clip: name, number of frames, and use of the clip by the trials."""
        return await self._run(self._sync.clips)

    async def records(self, *, revision: int | None = None) -> dict[str, dict[str, NDArray[Any]]]:
        """Return every tick of every trial, by the name of the trial; `record_arrays` describes the arrays."""
        return await self._run(self._sync.records, revision=revision)

    async def walk_graph(self, *, trial: str | None = None) -> dict[str, Any]:
        """Return the frames that the trials displayed, the jumps between frames, and the walk of each trial, as lists.

        * `clips`: identifier, name and number of frames of each clip;
        * `nodes`: the lists `clip`, `frame` and `ticks`, with one element for each displayed frame: the index of the
          clip, the number of the frame in this clip, and the number of ticks for which the frame was displayed;
        * `edges`: the lists `source`, `target` and `count`: the indices of two nodes, and the number of jumps from the
          first to the second;
        * `walks`: for each trial, in the order of the list `trials` of names, the lists `tick`, `clip`, `frame` and
          `frames`, with one element for each run of successive frames: first tick, clip, first frame, and number of
          frames.

        Without `trial`, the graph is that of all trials together.
        """
        return await self._run(self._sync.walk_graph, trial=trial)

    async def save_walk_graph(self, path: str | Path, *, trial: str | None = None) -> Path:
        """Write the walk graph to a file, as GraphML or JSON according to the ending of `path`; return the path."""
        return await self._run(self._sync.save_walk_graph, path, trial=trial)

    async def compare(
        self,
        *others: AsyncEvaluationHandle,
        on_progress: AsyncOnProgress | None = None,
        **options: Unpack[CompareKeywords],
    ) -> AsyncFindings:
        """Compare this evaluation with one or more others that have the same trials and the same scaling of features.

        `options` are those of `CompareParams`.
        """
        exchanged: AsyncFindings = await self._exchange(self._sync.compare, *others, on_progress=on_progress, **options)
        return exchanged

    async def suggest(
        self,
        candidates: AsyncPlaces[AsyncClipHandle] = (),
        *,
        metric: AsyncMetric | None = None,
        on_progress: AsyncOnProgress | None = None,
        **options: Unpack[SuggestKeywords],
    ) -> AsyncFindings:
        """Find clips that can be removed, and `candidates` (clips or folders of clips) that fill gaps in the coverage.

        `options` are those of `SuggestParams`. With a `metric`, near-duplicates that look different are kept.
        """
        exchanged: AsyncFindings = await self._exchange(
            self._sync.suggest, candidates, metric=metric, on_progress=on_progress, **options
        )
        return exchanged

    async def optimise(
        self,
        candidates: AsyncPlaces[AsyncClipHandle] = (),
        *,
        on_progress: AsyncOnProgress | None = None,
        **options: Unpack[OptimiseKeywords],
    ) -> AsyncFindings:
        """Find clips to remove and candidates to add, step by step, as long as each step lowers the objective function.

        `options` are those of `OptimiseParams`.
        """
        exchanged: AsyncFindings = await self._exchange(
            self._sync.optimise, candidates, on_progress=on_progress, **options
        )
        return exchanged

    async def sweep(
        self, *, on_progress: AsyncOnProgress | None = None, **options: Unpack[SweepKeywords]
    ) -> AsyncFindings:
        """Evaluate the same trials with other weights of the features; `options` are those of `SweepParams`."""
        exchanged: AsyncFindings = await self._exchange(self._sync.sweep, on_progress=on_progress, **options)
        return exchanged

    def compare_request(self, *others: AsyncEvaluationHandle, **options: Unpack[CompareKeywords]) -> JobCreate:
        """Return the job request of `compare`; `options` are those of `CompareParams`."""
        exchanged: JobCreate = self._now(self._sync.compare_request, *others, **options)
        return exchanged

    async def suggest_request(
        self,
        candidates: AsyncPlaces[AsyncClipHandle] = (),
        *,
        metric: AsyncMetric | None = None,
        **options: Unpack[SuggestKeywords],
    ) -> JobCreate:
        """Return the job request of `suggest`; `options` are those of `SuggestParams`."""
        exchanged: JobCreate = await self._exchange(self._sync.suggest_request, candidates, metric=metric, **options)
        return exchanged

    async def optimise_request(
        self, candidates: AsyncPlaces[AsyncClipHandle] = (), **options: Unpack[OptimiseKeywords]
    ) -> JobCreate:
        """Return the job request of `optimise`; `options` are those of `OptimiseParams`."""
        exchanged: JobCreate = await self._exchange(self._sync.optimise_request, candidates, **options)
        return exchanged

    def sweep_request(self, **options: Unpack[SweepKeywords]) -> JobCreate:
        """Return the job request of `sweep`; `options` are those of `SweepParams`."""
        return self._sync.sweep_request(**options)

"""Evaluations of locomotion clips: results, and jobs that use them to improve the clips."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from marey_client.arguments import checked, checks_arguments
from marey_client.errors import BadArgument
from marey_client.handles.clips import ClipHandle
from marey_client.handles.findings import Findings
from marey_client.handles.metrics import Metric, metric_choice
from marey_client.handles.reports import ReportedHandle, saved
from marey_client.items import Items
from marey_client.jobs import Jobs, OnProgress, job_request
from marey_client.keywords.evaluation import CompareKeywords, OptimiseKeywords, SuggestKeywords, SweepKeywords
from marey_client.places import Places, as_inputs, resolved
from marey_client.transport import sends_nothing
from marey_schemas.documents.evaluations import COSTS, MOST_EVALUATIONS_COMPARED, trial_name
from marey_schemas.documents.worst_first import worst_first
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_params import CompareParams, OptimiseParams, SuggestParams, SweepParams
from marey_schemas.queue.jobs import JobCreate

TRIAL_VERDICT = ("followed", "worst_rank", "beyond_limits")
"""Fields of a trial's verdict: whether it was followed, its rank among the worst trials (0: worst), exceeded limits."""


@checks_arguments
class EvaluationHandle(ReportedHandle):
    """Handle of an evaluation of locomotion clips: trials, use of the clips, report, and jobs to improve the clips."""

    def document(self, *, revision: int | None = None) -> dict[str, Any]:
        """Return options, provenance, metrics, usage and coverage of the evaluation, without the record of each tick.

        Arrays are numpy arrays.
        """
        return self.part("evaluation", revision=revision)

    def trials(self) -> list[dict[str, Any]]:
        """Return one row per trial: name, requested motion, verdict, and metrics."""
        return list(trial_rows(self.document()))

    def worst_trials(self) -> list[dict[str, Any]]:
        """Return the rows of `trials` from the worst trial to the best, in the order of the report."""
        return worst_rows_first(self.trials())

    def clips(self) -> list[dict[str, Any]]:
        """Return one row per clip: name, number of frames, and use of the clip by the trials."""
        return list(clip_rows(self.document()))

    def records(self, *, revision: int | None = None) -> dict[str, dict[str, NDArray[Any]]]:
        """Return every tick of every trial, by the name of the trial; `record_arrays` describes the arrays."""
        return record_arrays(self.part("records", revision=revision))

    def walk_graph(self, *, trial: str | None = None) -> dict[str, Any]:
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
        return dict(json.loads(self._walk_graph("json", trial)))

    def save_walk_graph(self, path: str | Path, *, trial: str | None = None) -> Path:
        """Write the walk graph to a file, as GraphML or JSON according to the ending of `path`; return the path."""
        form = Path(path).suffix.lower().removeprefix(".")
        if form not in ("json", "graphml"):
            raise BadArgument(f"{path}: the file name of a walk graph must end in .json or .graphml")
        return saved(path, self._walk_graph(form, trial))

    def _walk_graph(self, form: str, trial: str | None) -> bytes:
        return self._fetch(f"{self.url}/walk-graph", "*/*", {"format": form, "trial": trial})

    # -- jobs on the evaluation: each method submits one and waits for it, or raises `JobUnsuccessful` --

    def compare(
        self, *others: EvaluationHandle, on_progress: OnProgress | None = None, **options: Unpack[CompareKeywords]
    ) -> Findings:
        """Compare this evaluation with one or more others that have the same trials and the same scaling of features.

        `options` are those of `CompareParams`.
        """
        return self._run(self.compare_request(*others, **options), on_progress)

    def suggest(
        self,
        candidates: Places[ClipHandle] = (),
        *,
        metric: Metric | None = None,
        on_progress: OnProgress | None = None,
        **options: Unpack[SuggestKeywords],
    ) -> Findings:
        """Find clips that can be removed, and `candidates` (clips or folders of clips) that fill gaps in the coverage.

        `options` are those of `SuggestParams`. With a `metric`, near-duplicates that look different are kept.
        """
        return self._run(self.suggest_request(candidates, metric=metric, **options), on_progress)

    def optimise(
        self,
        candidates: Places[ClipHandle] = (),
        *,
        on_progress: OnProgress | None = None,
        **options: Unpack[OptimiseKeywords],
    ) -> Findings:
        """Find clips to remove and candidates to add, step by step, as long as each step lowers the objective function.

        `options` are those of `OptimiseParams`.
        """
        return self._run(self.optimise_request(candidates, **options), on_progress)

    def sweep(self, *, on_progress: OnProgress | None = None, **options: Unpack[SweepKeywords]) -> Findings:
        """Evaluate the same trials with other weights of the features; `options` are those of `SweepParams`."""
        return self._run(self.sweep_request(**options), on_progress)

    # -- requests for the same jobs --

    @sends_nothing
    def compare_request(self, *others: EvaluationHandle, **options: Unpack[CompareKeywords]) -> JobCreate:
        """Return the job request of `compare`; `options` are those of `CompareParams`."""
        if not 0 < len(others) < MOST_EVALUATIONS_COMPARED:
            raise BadArgument(
                f"between 2 and {MOST_EVALUATIONS_COMPARED} evaluations can be compared, not {1 + len(others)}"
            )
        after, *further = (other.as_input() for other in others)
        inputs: dict[str, Any] = {"before": self.as_input(), "after": after}
        if further:
            inputs["others"] = further
        return job_request("compare", inputs, checked(CompareParams, options))

    def suggest_request(
        self, candidates: Places[ClipHandle] = (), *, metric: Metric | None = None, **options: Unpack[SuggestKeywords]
    ) -> JobCreate:
        """Return the job request of `suggest`; `options` are those of `SuggestParams`."""
        chosen, named = metric_choice(metric)
        params = checked(SuggestParams, {**options, **named})
        return job_request("suggest", {**self._with_candidates(candidates), **chosen}, params)

    def optimise_request(self, candidates: Places[ClipHandle] = (), **options: Unpack[OptimiseKeywords]) -> JobCreate:
        """Return the job request of `optimise`; `options` are those of `OptimiseParams`."""
        return job_request("optimise", self._with_candidates(candidates), checked(OptimiseParams, options))

    @sends_nothing
    def sweep_request(self, **options: Unpack[SweepKeywords]) -> JobCreate:
        """Return the job request of `sweep`; `options` are those of `SweepParams`."""
        return job_request("sweep", {"evaluation": self.as_input()}, checked(SweepParams, options))

    def _with_candidates(self, candidates: Places[ClipHandle]) -> dict[str, Any]:
        inputs: dict[str, Any] = {"evaluation": self.as_input()}
        clips = Items(self.transport, self.project, Kind.CLIP, ClipHandle)
        if places := as_inputs(resolved(clips, candidates)):
            inputs["candidates"] = places
        return inputs

    def _run(self, request: JobCreate, on_progress: OnProgress | None) -> Findings:
        return Findings(self.transport, Jobs(self.transport).run(self.project, request, on_progress=on_progress))


# -- documents as tables -----------------------------------------------------------------------------------------------


def name_of_trial(trial: Mapping[str, Any]) -> str:
    """Return the name of a trial in an evaluation's document; the records of the trial have the same name."""
    angle_rad = trial.get("angle_rad", 0.0)  # evaluations of old versions have no angles
    return trial_name(trial["family"], trial["speed_m_s"], trial["turn_rate_rad_s"], angle_rad, trial.get("label", ""))


def trial_rows(document: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Return one flat row for each trial of an evaluation's document: its requested motion, verdict and metrics.

    Evaluations of old versions have no verdict on single trials.
    """
    for one in document["trials"]:
        asked = one["trial"]
        turn_rate_deg_s = math.degrees(asked["turn_rate_rad_s"])
        yield {
            "trial": name_of_trial(asked),
            "family": asked["family"],
            "speed_m_s": asked["speed_m_s"],
            "turn_rate_deg_s": turn_rate_deg_s,
            "angle_deg": math.degrees(asked.get("angle_rad", 0.0)),
            **{name: one[name] for name in TRIAL_VERDICT if name in one},
            **one["metrics"],
        }


def worst_rows_first(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Sort rows of trials from the worst to the best.

    Evaluations of old versions do not rank their trials; these are sorted by their distance from the path.
    """

    def badness(row: Mapping[str, Any]) -> float | None:
        return -row["worst_rank"] if "worst_rank" in row else row.get("offset_mean")

    return worst_first(map(dict, rows), badness, lambda row: str(row["trial"]), undefined_is_worst=True)


def clip_rows(document: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield one row for each clip of an evaluation's document: number of frames, and how much the trials used the clip.

    Frames are counted at the rate of the trials.
    """
    usage = document["usage"]
    columns = zip(*(usage[name].tolist() for name in ("ticks", "share", "entries", "trials")), strict=True)
    for clip, (ticks, share, entries, trials) in zip(document["clips"], columns, strict=True):
        yield {
            "clip": clip["name"],
            "uid": clip["uid"],
            "mirrored": clip["mirrored_from"] is not None,
            "loop": clip["loop"],
            "frames": clip["stop"] - clip["start"],
            "ticks": ticks,
            "share": share,
            "entries": entries,
            "trials": trials,
        }


def record_arrays(document: Mapping[str, Any]) -> dict[str, dict[str, NDArray[Any]]]:
    """Return the arrays of each trial, by the name of the trial; a trial has T ticks, `rate_hz` per second.

    rows (T,): displayed row of the database
    positions (T, 2): root on the ground, x and z, in metres
    headings (T,): in radians
    status (T,): 0 the clip continues, 1 first row after a switch, 2 last row before a switch, 3 first row of the trial,
        first row after the end of a clip, or first row of a new round of a loop
    match_cost, continuing_cost, pose_cost (T,): NaN at ticks without this cost
    """
    starts = document["starts"].tolist()
    columns = {name: document[name] for name in ("rows", "positions", "headings", "status")}
    for name in COSTS:
        columns[name] = np.full(starts[-1], np.nan)
        columns[name][document[name]["ticks"]] = document[name]["values"]
    return {
        trial: {name: column[start:stop] for name, column in columns.items()}
        for trial, start, stop in zip(document["trials"], starts, starts[1:], strict=False)
    }

"""Search for the first version of a dataset whose evaluation has a metric beyond a limit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from marey_client.errors import CannotBisect, Invalid, JobUnsuccessful
from marey_client.handles.bisections import Bisection, VersionRange, VersionTest, bisect
from marey_client.handles.evaluations import EvaluationHandle
from marey_client.handles.versions import DatasetHandle
from marey_client.jobs import Jobs, OnProgress
from marey_client.project_items import ProjectItems
from marey_client.submitting.requests import evaluate_request
from marey_schemas.datasets.commits import Commit
from marey_schemas.documents.evaluations import HEADLINE_METRICS
from marey_schemas.documents.replicates import mean_interval
from marey_schemas.queue.job_params import EvaluateParams
from marey_schemas.queue.jobs import CacheMode, DatasetInput, Job, JobOutput, JobState

NAME_DIGITS = 12
"""Number of digits of a commit's digest in the name of its evaluation."""


@dataclass(frozen=True)
class Limit:
    """Limit of a metric. Values above the limit are bad; if `above` is false, values below the limit are bad."""

    value: float
    above: bool = True

    def exceeded_by(self, value: float) -> bool:
        """Return whether a value is bad: above the limit, or below it if `above` is false."""
        return value > self.value if self.above else value < self.value

    def __str__(self) -> str:
        return f"{'above' if self.above else 'below'} {self.value:.6g}"


@dataclass(frozen=True)
class Measurement:
    """Value of the metric at a version; None if the version cannot be evaluated, for the given `reason`.

    `output` is the revision of the evaluation. `reused` is true if this evaluation existed before, or belongs to
    another version with the same entries.
    """

    commit: Commit
    value: float | None
    output: JobOutput | None = None
    reused: bool = False
    reason: str = ""


@dataclass(frozen=True)
class ParentChange:
    """Change of the metric from a parent of the first bad version to this version.

    `interval` has the bounds, at 95 % confidence, of the mean change over the replicates. It is None if the metric is
    not a mean over trials, or if the evaluations have too few replicates.
    """

    parent: Measurement
    interval: tuple[float, float] | None

    @property
    def may_be_noise(self) -> bool:
        """Whether the interval contains 0."""
        return self.interval is not None and self.interval[0] <= 0.0 <= self.interval[1]


@dataclass(frozen=True)
class Crossing:
    """Result of a search for the first version at which a metric has crossed a limit.

    Parameters
    ----------
    search : the tests of versions, and the versions that can be the first bad one according to the tests
    metric, limit : name of the metric, and the limit that its value has crossed
    measurements : values at the tested versions and at the parents of the first bad one, in the order of measuring
    changes : if there is a single first bad version, the change of the metric from each of its parents
    """

    search: Bisection
    metric: str
    limit: Limit
    measurements: tuple[Measurement, ...]
    changes: tuple[ParentChange, ...]

    @property
    def first_bad(self) -> Commit | None:
        """The first bad version, or None if several versions can be the first bad one."""
        return self.search.first_bad

    def value(self, commit: Commit) -> float | None:
        """Return the value of the metric at a version; None if the version was not evaluated or cannot be evaluated."""
        return next((one.value for one in self.measurements if one.commit.digest == commit.digest), None)


OnMeasured = Callable[[VersionTest, Measurement, int], None]
"""Function called after each test with its result, the value, and the number of tests that are still expected."""


@dataclass
class VersionEvaluations:
    """Evaluations of versions of a dataset; versions with the same entries are evaluated once.

    Parameters
    ----------
    project, dataset : the dataset and its project
    metric : name of the metric, one of `HEADLINE_METRICS`
    params : options of the evaluations; each evaluation is named after the digest of its version
    path : folder of the dataset whose clips are evaluated; empty: all clips
    into : folder that receives the evaluations; None: the name of the dataset with `-bisect` at its end
    normaliser : evaluation whose scales of features are used, as a handle or an id; None: each evaluation computes its
        own scales

    Raises `CannotBisect` if there is no such metric.
    """

    project: ProjectItems
    dataset: DatasetHandle
    metric: str
    params: EvaluateParams
    path: str = ""
    into: str | None = None
    normaliser: EvaluationHandle | str | None = None
    priority: int = 0
    cache: CacheMode = "use"
    on_progress: OnProgress | None = None
    measured: dict[str, Measurement] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        if self.metric not in HEADLINE_METRICS:
            names = ", ".join(HEADLINE_METRICS)
            raise CannotBisect(f"evaluations have no metric {self.metric!r}; their metrics are {names}")

    def measure(self, commit: Commit) -> Measurement:
        """Return the value of the metric at a version; versions with the same entries share one evaluation.

        An evaluation that is interrupted by Ctrl-C is cancelled.
        """
        if commit.digest not in self.measured:
            same = next((one for one in self.measured.values() if one.commit.tree == commit.tree), None)
            self.measured[commit.digest] = (
                self._evaluated(commit)
                if same is None
                else Measurement(commit, same.value, same.output, True, same.reason)
            )
        return self.measured[commit.digest]

    def _evaluated(self, commit: Commit) -> Measurement:
        jobs = Jobs(self.project.transport)
        try:
            submitted = self._submit(jobs, commit)
        except Invalid as error:  # the version has no clips, or clips without content
            return Measurement(commit, None, reason=error.detail)
        try:
            ended = jobs.wait(submitted.id, on_progress=self.on_progress, require_success=False)
        except KeyboardInterrupt:
            jobs.cancel(submitted.id)
            raise
        if ended.state is JobState.CANCELLED:
            raise JobUnsuccessful(f"the evaluation job {ended.id} was cancelled; repeat the search", ended)
        if ended.state is not JobState.SUCCEEDED:
            return Measurement(commit, None, reason=f"job {ended.id} failed" + _detail(ended))
        (output,) = jobs.outputs(ended.id)
        value, reused = (ended.result or {}).get(self.metric), ended.cached_from is not None
        reason = f"{self.metric} is not defined" if value is None else ""
        return Measurement(commit, None if value is None else float(value), output, reused, reason)

    def _submit(self, jobs: Jobs, commit: Commit) -> Job:
        clips = DatasetInput(dataset=self.dataset.name, version=commit.digest, path=self.path)
        name = commit.digest.partition(":")[2][:NAME_DIGITS]
        params = self.params.model_copy(update={"name": name, "report": False})
        request = evaluate_request(self.project, clips, params, self.normaliser)
        chosen = {
            "into": f"{self.dataset.name}-bisect" if self.into is None else self.into,
            "priority": self.priority,
            "cache": self.cache,
        }
        return jobs.submit(self.project.name, request.model_copy(update=chosen))

    def interval(self, before: Measurement, after: Measurement) -> tuple[float, float] | None:
        """Return the bounds, at 95 % confidence, of the mean change of the metric over the replicates of two versions.

        Returns None if the metric is not a mean over trials, if a version was not evaluated, or if there are too few
        replicates.
        """
        metric = HEADLINE_METRICS[self.metric].of_trials
        if metric is None or before.output is None or after.output is None:
            return None
        return change_interval(self._document(before.output), self._document(after.output), metric)

    def _document(self, output: JobOutput) -> Mapping[str, Any]:
        return self.project.evaluations.get(output.item).document(revision=output.revision)


def find_crossing(
    among: VersionRange, evaluations: VersionEvaluations, limit: Limit | None, on_measured: OnMeasured | None = None
) -> Crossing:
    """Evaluate both ends of a range of versions, then versions between them until the first bad one is found.

    Without `limit`, the limit is half-way between the values at the ends. Raises `CannotBisect` if an end cannot be
    evaluated, if the good end is bad, if the bad end is good, or if both ends have the same value and no limit is
    given.
    """
    limit = _checked_limit(among, evaluations, limit)

    def is_bad(commit: Commit) -> bool | None:
        value = evaluations.measure(commit).value
        return None if value is None else limit.exceeded_by(value)

    def on_step(step: VersionTest, left: int) -> None:
        if on_measured is not None:
            on_measured(step, evaluations.measure(step.commit), left)

    found = bisect(among, is_bad, on_step)
    changes = _changes(among, evaluations, found.first_bad) if found.first_bad is not None else ()
    return Crossing(found, evaluations.metric, limit, tuple(evaluations.measured.values()), changes)


def _checked_limit(among: VersionRange, evaluations: VersionEvaluations, limit: Limit | None) -> Limit:
    good, bad = _end(evaluations, among.good, "good"), _end(evaluations, among.bad, "bad")
    values = f"{evaluations.metric} is {good:.6g} at the good version and {bad:.6g} at the bad one"
    if limit is None:
        if good == bad:
            raise CannotBisect(f"{values}, so no value is half-way between them; give a limit")
        limit = Limit((good + bad) / 2, above=bad > good)
    if limit.exceeded_by(good):
        if limit.exceeded_by(bad):
            end = "both versions are bad; give another limit, or an earlier good version"
        else:
            end = "the good version is bad and the bad one is good; exchange the versions, or give another limit"
        raise CannotBisect(f"{values}; values {limit} are bad, so {end}")
    if not limit.exceeded_by(bad):
        raise CannotBisect(
            f"{values}; values {limit} are bad, so both versions are good; give another limit, or a later bad version"
        )
    return limit


def _end(evaluations: VersionEvaluations, commit: Commit, which: str) -> float:
    found = evaluations.measure(commit)
    if found.value is None:
        raise CannotBisect(f"the {which} version, {commit.digest}, cannot be evaluated: {found.reason}")
    return found.value


def _changes(among: VersionRange, evaluations: VersionEvaluations, first_bad: Commit) -> tuple[ParentChange, ...]:
    """Return the change of the metric from each parent of the first bad version; evaluate parents if necessary."""
    after = evaluations.measure(first_bad)
    changes = []
    for digest in among.parents[first_bad.digest]:
        commit = among.commits.get(digest) or evaluations.dataset.at(digest)
        before = evaluations.measure(commit)
        changes.append(ParentChange(before, evaluations.interval(before, after)))
    return tuple(changes)


def change_interval(before: Mapping[str, Any], after: Mapping[str, Any], metric: str) -> tuple[float, float] | None:
    """Compute the bounds of the mean change of a metric of the suite over the replicates of two evaluations.

    Parameters
    ----------
    before, after : documents of the evaluations
    metric : name of the metric

    Returns
    -------
    (2,) float    bounds at 95 % confidence, in the unit of the metric; None if the evaluations have too few replicates
    """
    sides = [(document.get("replicates") or {}).get("suite", {}).get(metric, ()) for document in (before, after)]
    changes = [
        second - first for first, second in zip(*sides, strict=False) if first is not None and second is not None
    ]
    found = mean_interval(changes) if changes else None
    return None if found is None or found.low is None or found.high is None else (found.low, found.high)


def _detail(job: Job) -> str:
    return "" if job.failure is None else f" ({job.failure.code}): {job.failure.detail}"

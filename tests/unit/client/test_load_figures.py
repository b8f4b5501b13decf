"""Figures of load tests: percentiles, confidence intervals, planned times, and metrics of the server."""

import itertools
import math
import statistics

import pytest
import scipy.stats

from marey_client.cli.operation.bench import _plan
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.errors import MareyError
from marey_client.load.figures import Estimate, RateFigures, Replicate, percentile, read_samples
from marey_client.load.measuring import LoadPlan
from marey_client.load.offering import arrival_times


def test_an_interval_is_that_of_student_and_one_value_has_none() -> None:
    values = [10.0, 12.0, 17.0]
    low, high = scipy.stats.t.interval(0.95, 2, statistics.fmean(values), scipy.stats.sem(values))
    found = Estimate.of(values)
    assert found.margin is not None
    assert (found.value - found.margin, found.value + found.margin) == pytest.approx((low, high), rel=1e-3)
    assert Estimate.of([3.0]) == Estimate(3.0, None)


def test_a_percentile_is_a_measured_value() -> None:
    values = list(range(1, 101))
    assert [percentile(values, percent) for percent in (50, 95, 99, 100)] == [50, 95, 99, 100]
    assert percentile([7.0], 99) == 7.0
    assert math.isnan(percentile([], 50))


def test_errors_are_added_up_and_a_rate_without_starts_has_no_delays() -> None:
    some = Replicate(2.0, 10, 8, [0.1] * 8, {"claim: unavailable": 2})
    none = Replicate(2.0, 10, 0, [], {"claim: unavailable": 1, "submit: quota-exceeded": 4})
    found = RateFigures.of(5, [some, none], {})
    assert found.errors == {"claim: unavailable": 3, "submit: quota-exceeded": 4}
    assert (found.unfinished, found.start_ms, found.cycles_per_s.value) == (12, {}, 2.0)


def test_jobs_are_planned_at_random_times_of_the_given_rate() -> None:
    times = arrival_times(50.0, 200.0, seed=3)
    assert times == arrival_times(50.0, 200.0, seed=3) != arrival_times(50.0, 200.0, seed=4)
    assert times == sorted(times)
    assert times[-1] < 200.0
    assert abs(len(times) - 10_000) < 4 * math.sqrt(10_000)
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    assert scipy.stats.kstest(gaps, "expon", args=(0, 1 / 50)).pvalue > 0.01


def test_metrics_are_read_with_their_labels_and_other_texts_are_refused() -> None:
    text = '# HELP a b\nprocess_cpu_seconds_total 1.5\nmarey_waiting{lane="database"} 3.0\n'
    assert read_samples(text) == {"process_cpu_seconds_total": 1.5, 'marey_waiting{lane="database"}': 3.0}
    with pytest.raises(MareyError, match="no metrics"):
        read_samples("<html>a proxy</html>")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("10,x", 20.0, 3, 4, 0.0, 0), "numbers with commas"),
        (("0", 20.0, 3, 4, 0.0, 0), "greater than 0"),
        (("nan", 20.0, 3, 4, 0.0, 0), "greater than 0"),
        (("1e9", 20.0, 3, 4, 0.0, 0), "at most 10,000"),
        (("10", 0.0, 3, 4, 0.0, 0), "seconds of a run"),
        (("10", 20.0, 11, 4, 0.0, 0), "replicates"),
        (("10", 20.0, 3, 1000, 0.0, 0), "workers"),
    ],
)
def test_wrong_options_are_refused_with_the_reason(options: tuple[str, float, int, int, float, int], said: str) -> None:
    with pytest.raises(WrongUsage, match=said):
        _plan(*options)


@pytest.mark.parametrize("work_s", [math.inf, math.nan, -1.0, 1e9])
def test_work_without_end_is_refused(work_s: float) -> None:
    with pytest.raises(ValueError, match="work of a job"):
        LoadPlan((5.0,), work_s=work_s)

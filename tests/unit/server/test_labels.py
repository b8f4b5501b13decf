"""Labels stored as one text."""

from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marey_server.access.labels import MOST_LABELS, keys_within, labels_key, labels_of
from marey_server.errors import InvalidProblem

names = st.text(min_size=1, max_size=8)
label_sets = st.dictionaries(names, st.text(max_size=8), max_size=4)


@given(label_sets, label_sets)
def test_a_worker_matches_exactly_the_jobs_whose_labels_it_carries(job: dict[str, str], worker: dict[str, str]) -> None:
    assert (labels_key(job) in keys_within(worker)) == (job.items() <= worker.items())


@given(label_sets, label_sets)
def test_different_labels_have_different_keys(one: dict[str, str], other: dict[str, str]) -> None:
    assert (labels_key(one) == labels_key(other)) == (one == other)


@given(label_sets)
def test_labels_can_be_read_from_their_text(labels: dict[str, str]) -> None:
    assert labels_of(labels_key(labels)) == labels


def test_a_worker_with_all_its_labels_matches_every_subset() -> None:
    labels = {f"label{n}": str(n) for n in range(MOST_LABELS)}
    subsets = [dict(some) for size in range(MOST_LABELS + 1) for some in combinations(labels.items(), size)]
    assert sorted(keys_within(labels)) == sorted(labels_key(subset) for subset in subsets)


def test_labels_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InvalidProblem):
        labels_key({f"label{n}": "x" for n in range(MOST_LABELS + 1)})
    with pytest.raises(InvalidProblem):
        labels_key({"name": "x" * 600})

"""Labels of jobs and workers: all labels of a job are stored as one indexed text."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from urllib.parse import quote, unquote

from marey_schemas.problems import FieldError
from marey_server.errors import InvalidProblem

MOST_LABELS = 6
"""Greatest number of labels; a worker with n labels matches 2 to the power n sets of labels."""

LONGEST_KEY = 512


def labels_key(labels: Mapping[str, str]) -> str:
    """Return labels as one text in a fixed order, such as `gpu=a100,site=lyon`.

    Raises `InvalidProblem` if there are too many labels, or if the text has more than `LONGEST_KEY` characters.
    """
    pairs = _checked_pairs(labels)
    key = ",".join(pairs)
    if len(key) > LONGEST_KEY:
        raise _refusal(f"The labels have {len(key)} characters in total; at most {LONGEST_KEY} are allowed.")
    return key


def labels_of(key: str) -> dict[str, str]:
    """Return the labels that `labels_key` has encoded as the text `key`."""
    pairs = (pair.partition("=") for pair in key.split(",") if pair)
    return {unquote(name): unquote(value) for name, _, value in pairs}


def keys_within(labels: Mapping[str, str]) -> list[str]:
    """Return the key of every subset of a worker's `labels`, beginning with the empty set.

    The worker satisfies the jobs whose labels have one of these keys.
    """
    pairs = _checked_pairs(labels)
    return [",".join(subset) for size in range(len(pairs) + 1) for subset in combinations(pairs, size)]


def is_within(key: str, other: str) -> bool:
    """Return whether all labels in `key` are also in `other`.

    If so, every worker that may run jobs with the labels in `other` may also run jobs with the labels in `key`.
    """
    return key == "" or set(key.split(",")) <= set(other.split(","))


def first_outside(labels: Mapping[str, str], allowed: Mapping[str, str] | None) -> str | None:
    """Return the first label that is not allowed, as `name=value`, or None if all are allowed.

    `allowed` is None if every label is allowed.
    """
    if allowed is None:
        return None
    return next((f"{name}={value}" for name, value in sorted(labels.items() - allowed.items())), None)


def _checked_pairs(labels: Mapping[str, str]) -> list[str]:
    if len(labels) > MOST_LABELS:
        raise _refusal(f"There are {len(labels)} labels; at most {MOST_LABELS} are allowed.")
    return [f"{quote(name, safe='')}={quote(value, safe='')}" for name, value in sorted(labels.items())]


def _refusal(detail: str) -> InvalidProblem:
    return InvalidProblem(detail, errors=[FieldError(pointer="/labels", code="too-long", detail=detail)])

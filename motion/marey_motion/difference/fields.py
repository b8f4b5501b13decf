"""Differences between documents: fields whose values differ, and differences in the training of models."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from marey_schemas.documents.differences import Change, ModelDifference
from marey_schemas.documents.models import log_likelihoods

MOST_TEXT = 2000
"""Maximum length, in characters, of a value as JSON text.

Longer strings are cut off; longer lists and objects are replaced by a description.
"""


class ChangedValue(NamedTuple):
    """A value that differs between two documents.

    Parameters
    ----------
    pointer : str    JSON pointer of the value
    change : str    "added", "removed" or "changed"
    before, after : JSON values    `before` is None if the value was added, `after` if it was removed
    """

    pointer: str
    change: Change
    before: Any = None
    after: Any = None


def changed_values(before: Any, after: Any, pointer: str = "") -> Iterator[ChangedValue]:
    """Compare two documents.

    Objects are compared field by field, and lists of equal length entry by entry. If two lists have different lengths,
    an entry that is in only one of the lists counts as removed or added. Arrays are compared as a whole. Null, an empty
    list and an empty object count as absent values.

    Parameters
    ----------
    before, after : JSON values and arrays    the documents
    pointer : str    JSON pointer to `before` and `after` in the documents that contain them

    Yields
    ------
    ChangedValue    in the order of the documents
    """
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        yield from _changed_members(before, after, pointer)
    elif _is_list(before) and _is_list(after) and len(before) == len(after):
        for place, (old, new) in enumerate(zip(before, after, strict=True)):
            yield from changed_values(old, new, f"{pointer}/{place}")
    elif _is_list(before) and _is_list(after):
        yield from _changed_entries(before, after, pointer)
    elif not _equal(before, after):
        yield ChangedValue(pointer, "changed", _shown(before), _shown(after))


def _changed_members(before: Mapping[str, Any], after: Mapping[str, Any], pointer: str) -> Iterator[ChangedValue]:
    for name in dict.fromkeys((*before, *after)):
        place = f"{pointer}/{name.replace('~', '~0').replace('/', '~1')}"
        old, new = before.get(name), after.get(name)
        if _is_nothing(old) and _is_nothing(new):
            continue
        if _is_nothing(old) and not _is_list(new):
            yield ChangedValue(place, "added", after=_shown(new))
        elif _is_nothing(new) and not _is_list(old):
            yield ChangedValue(place, "removed", before=_shown(old))
        else:
            yield from changed_values([] if _is_nothing(old) else old, [] if _is_nothing(new) else new, place)


def _is_nothing(value: Any) -> bool:
    """Return whether a value is null, an empty list or an empty object, all of which count as absent values."""
    return value is None or (isinstance(value, (Mapping, list, tuple)) and not value)


def _changed_entries(before: Sequence[Any], after: Sequence[Any], pointer: str) -> Iterator[ChangedValue]:
    old, new = [_key(one) for one in before], [_key(one) for one in after]
    spare = Counter(old) - Counter(new)
    for place, key in enumerate(old):
        if spare[key]:
            spare[key] -= 1
            yield ChangedValue(f"{pointer}/{place}", "removed", before=_shown(before[place]))
    spare = Counter(new) - Counter(old)
    for place, key in enumerate(new):
        if spare[key]:
            spare[key] -= 1
            yield ChangedValue(f"{pointer}/{place}", "added", after=_shown(after[place]))


def _is_list(value: Any) -> bool:
    return isinstance(value, (list, tuple))


def _equal(before: Any, after: Any) -> bool:
    if isinstance(before, np.ndarray) and isinstance(after, np.ndarray):
        return before.shape == after.shape and np.array_equal(before, after, equal_nan=before.dtype.kind == "f")
    if isinstance(before, np.ndarray) or isinstance(after, np.ndarray):
        return False
    return type(before) is type(after) and bool(before == after)


def _key(value: Any) -> str:
    return json.dumps(value, sort_keys=True, default=lambda array: array.tolist())


def _shown(value: Any) -> Any:
    """Return a value as it appears in a difference: arrays, long lists and long objects become short descriptions.

    A long string is cut off.
    """
    if isinstance(value, np.ndarray):
        return f"array of {' x '.join(str(size) for size in value.shape)} numbers"
    text = json.dumps(value, default=_shown)
    if len(text) <= MOST_TEXT:
        return json.loads(text)
    if isinstance(value, str):
        return f"{value[:MOST_TEXT]}…"
    return f"{'list' if _is_list(value) else 'object'} of {len(value)} values"


def compare_models(before: Mapping[str, Any], after: Mapping[str, Any]) -> ModelDifference:
    """Describe how the training of two models differs: in examples and in likelihood.

    Parameters
    ----------
    before, after : mapping    `model` documents, of the current or an older version of their schema

    Returns
    -------
    ModelDifference    added and removed examples, and the mean log likelihood of both models, None for a model that
        does not store it
    """
    old, new = _examples(before), _examples(after)
    return ModelDifference(
        examples=(len(old), len(new)),
        examples_added=tuple(name for key, name in new.items() if key not in old),
        examples_removed=tuple(name for key, name in old.items() if key not in new),
        mean_log_likelihood=(_mean_likelihood(before), _mean_likelihood(after)),
    )


def _examples(model: Mapping[str, Any]) -> dict[Any, str]:
    """Map the revision of each training example to its name; without stored revisions, map each name to itself."""
    provenance = model.get("provenance") or {}
    aligned = provenance.get("aligned") or ()
    if all(isinstance(one, Mapping) and {"item", "revision"} <= one.keys() for one in aligned) and aligned:
        return {(one["item"], one["revision"]): str(one.get("name", one["item"])) for one in aligned}
    examples = (model.get("training") or {}).get("examples") or ()
    names = [str(one["name"]) for one in examples if isinstance(one, Mapping) and "name" in one]
    return dict(zip(names, names, strict=True))


def _mean_likelihood(model: Mapping[str, Any]) -> float | None:
    values = log_likelihoods(model)
    return float(np.mean(values)) if values else None

"""Digests of the content and of the conditions of an evaluation; they show whether two evaluations are comparable."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from typing import Any

import numpy as np

from marey_motion.errors import MotionError
from marey_motion.evaluation.result import Provenance
from marey_motion.evaluation.scenario import Trial
from marey_motion.matching.database import DatabaseClip, MatchingDatabase
from marey_motion.version import code_version
from marey_schemas.base import Options
from marey_schemas.encoding.digests import digest_of, digest_of_hash
from marey_schemas.options.evaluation import EvaluationOptions


def provenance_of(database: MatchingDatabase, options: EvaluationOptions, trials: Sequence[Trial]) -> Provenance:
    """Compute the digests of the data, the cost function and the trials.

    `dataset` is the digest of the motion that was played, without the names of the clips. `clips` maps the uid of each
    clip to the digest of its document or, if the document is not known, of its motion.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    options : EvaluationOptions    options of the evaluation
    trials : sequence of Trial    the trials

    Returns
    -------
    Provenance    digests "sha256:…"
    """
    rows = [_rows_digest(database, clip) for clip in database.clips]
    return Provenance(
        dataset=_digest(sorted(rows)),
        clips={clip.uid: clip.content or own for clip, own in zip(database.clips, rows, strict=True)},
        normaliser=database.normaliser.digest,
        options=_digest({"database": database.options, "controller": options.controller, "window": options.window}),
        scenarios=_digest([*map(_asked, trials), *_drawn(options)]),
        code_version=code_version(),
        limits=_digest(options.limits),
    )


def _asked(trial: Trial) -> dict[str, Any]:
    """Return the members of a trial that its digest covers; members in `_LATER_MEMBERS` are left out if they are empty.

    So a trial without these members has the same digest as in versions that did not have the members.
    """
    return {name: value for name, value in asdict(trial).items() if name not in _LATER_MEMBERS or value}


_LATER_MEMBERS = ("angle_rad", "left_out", "label", "path")


def _drawn(options: EvaluationOptions) -> list[dict[str, int]]:
    """Return number and seed of the replicates for the digest; empty if each trial runs only once."""
    return [{"replicates": options.replicates, "seed": options.seed}] if options.replicates > 1 else []


def require_comparable(
    before: Provenance, after: Provenance, options: Mapping[str, Sequence[str]] | None = None
) -> None:
    """Check that the normalisers, options, scenarios and limits of two evaluations agree.

    Parameters
    ----------
    before, after : Provenance    digests of the two evaluations
    options : mapping of str to sequence of str, optional    options that differ, as made by `differing_options`

    Raises
    ------
    MotionError    if any of these differ; the error names all differences
    """
    different = {
        name: f"their {plural} differ ({_named((options or {}).get(name, ()), first, second)}): {remedy}"
        for name, (plural, remedy) in _CONDITIONS.items()
        if (first := getattr(before, name)) != (second := getattr(after, name))
    }
    if different:
        raise MotionError(
            f"these evaluations cannot be compared: {'; '.join(different.values())}",
            code="not-comparable",
            where=", ".join(different),
        )


def differing_options(before: EvaluationOptions, after: EvaluationOptions) -> dict[str, list[str]]:
    """Describe the options that differ between two evaluations, grouped by the condition that they change.

    Options change the conditions "options", "scenarios" and "limits". The normaliser is a further condition of a
    comparison.

    Parameters
    ----------
    before, after : EvaluationOptions    the options

    Returns
    -------
    dict of str to list of str    such as {"scenarios": ["seed: 0 and 1"]}
    """
    found: dict[str, list[str]] = {}
    first, second = (dict(_flat("", options.model_dump())) for options in (before, after))
    for name in first.keys() | second.keys():
        condition = _CONDITION_OF.get(name.partition(".")[0])
        if condition is not None and (one := first.get(name, "none")) != (other := second.get(name, "none")):
            found.setdefault(condition, []).append(f"{name}: {one} and {other}")
    return {condition: sorted(texts) for condition, texts in found.items()}


_CONDITION_OF = {
    **dict.fromkeys(("database", "controller", "window"), "options"),
    **dict.fromkeys(("speeds_m_s", "turn_rates_deg_s", "families", "approach_s", "duration_s"), "scenarios"),
    **dict.fromkeys(("switch_speed_m_s", "switch_every_s", "replicates", "seed"), "scenarios"),
    **dict.fromkeys(("corner_angles_deg", "strafe_angles_deg", "most_takes"), "scenarios"),
    "limits": "limits",
}
"""For each member of the evaluation options, the condition of a comparison that changes with this member.

The members `coverage_least_s` and `literal_formulas` are missing, because two evaluations can be compared even if these
members differ.
"""
_NAMED = 5
"""Greatest number of differing options that an error names."""

_CONDITIONS = {
    "normaliser": ("normalisers", "evaluate both with one pinned normaliser, or with one fitted on both"),
    "options": ("options", "evaluate both with the same database, controller and window"),
    "scenarios": ("scenarios", "evaluate both over the same trials, with the same replicates and the same seed"),
    "limits": (
        "limits of the verdict",
        "evaluate both with the same limits; an evaluation by an old version has no limits and must be made again",
    ),
}


def _named(texts: Sequence[str], first: str, second: str) -> str:
    """Describe a difference: the options that differ or, if `texts` is empty, the two digests."""
    if not texts:
        return f"{_short(first)} and {_short(second)}"
    more = f" and {len(texts) - _NAMED} more" if len(texts) > _NAMED else ""
    return f"{'; '.join(texts[:_NAMED])}{more}"


def _flat(prefix: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the dotted name of each option, and its value."""
    if isinstance(value, Mapping):
        for name, member in value.items():
            yield from _flat(f"{prefix}.{name}" if prefix else name, member)
    else:
        yield prefix, ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else value


def _rows_digest(database: MatchingDatabase, clip: DatabaseClip) -> str:
    """Compute the digest of a clip's rows as they are matched and played."""
    rows = slice(clip.start, clip.stop)
    digest = hashlib.sha256()
    for array in (
        database.features[rows],
        database.selectable[rows],
        database.root_positions[rows],
        database.root_headings[rows],
        database.pose_points[rows],
    ):
        digest.update(f"{array.dtype.str} {list(array.shape)}\n".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest_of_hash(digest)


def _digest(value: Any) -> str:
    text = json.dumps(_canonical(value), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return digest_of(text.encode())


def _canonical(value: Any) -> Any:
    """Convert a value to plain values in which equal numbers are written in the same way: 3 as 3.0, and -0.0 as 0.0."""
    if isinstance(value, Options):
        return _canonical(value.model_dump())
    if is_dataclass(value) and not isinstance(value, type):
        return _canonical(asdict(value))
    if isinstance(value, Mapping):
        return {key: _canonical(member) for key, member in value.items()}
    if isinstance(value, (list, tuple)):
        return [_canonical(item) for item in value]
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value) + 0.0
    return value


def _short(digest: str) -> str:
    return digest[: len("sha256:") + 12] or "none"

"""Where a model comes from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marey_motion.modelling.training import TrainedPrimitive
from marey_motion.version import code_version
from marey_reports.drawing.markup import Html, element, joined
from marey_reports.drawing.tables import folded, table

_ORIGINS = {"set": "aligned set", "reference": "reference", "seed": "seed"}


def provenance(trained: TrainedPrimitive, origin: Mapping[str, Any]) -> Html:
    """What the model was made of, by which options and which code."""
    known = [
        (label, element("code", str(origin[name]))) for name, label in _ORIGINS.items() if origin.get(name) is not None
    ]
    known.append(("version of the code", element("code", code_version())))
    options = [(name, _written(value)) for name, value in trained.options.as_tree().items()]
    clips = [
        (element("code", f"{clip['item']}@{clip['revision']}"), str(clip["name"])) for clip in origin.get("aligned", ())
    ]
    return joined(
        (
            element("p", "The same examples, options, seed and code give the same model to the bit."),
            table("Origin", ("what", "value"), known, numbers=(), sortable=False),
            folded("All options", table("Options", ("option", "value"), options, numbers=(), sortable=False)),
            folded("Every example", table("Aligned clips", ("clip", "name"), clips, numbers=())) if clips else None,
        )
    )


def _written(value: object) -> str:
    return "chosen by the data" if value is None else f"{value:g}" if isinstance(value, float) else str(value)

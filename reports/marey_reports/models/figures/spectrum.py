"""Figures about numbers of components: explained variance, reconstruction error, and size of the mixture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from marey_motion.arrays import Floats
from marey_reports.drawing.drawn import Sketch, Tables
from marey_reports.drawing.paper import (
    COLOURS,
    INK,
    QUIET,
    REFERENCE,
    Place,
    add_keys,
    add_panel,
    new_figure,
    tick_whole_numbers,
    write,
)
from marey_reports.models.figures.subjects import ModelSubject
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MOST_BARS = 40


def draw_variance(subject: ModelSubject) -> Sketch:
    """Draw the share of the variance that the first 1, 2, ... components explain, for poses and for time."""
    kinds = {
        "poses": (subject.report.spatial_energy, subject.primitive.spatial.count),
        "time": (subject.report.temporal_energy, subject.primitive.temporal.count),
    }
    figure = new_figure(9.6, 3.5)
    for place, (kind, (energy, kept)) in zip((Place(0.7, 0.65, 5.4, 2.4), Place(6.8, 0.65, 2.6, 2.4)), kinds.items(),
                                             strict=True):  # fmt: skip
        label = "variance explained (%)" if kind == "poses" else ""
        panel = add_panel(figure, place, title=f"{kind}: {kept} of {len(energy)} kept", x="components", y=label)
        _draw_bars(panel, energy, kept)
    tables: Tables = {
        kind: {"components": np.arange(1, len(energy) + 1), "share": energy, "kept": np.arange(len(energy)) < kept}
        for kind, (energy, kept) in kinds.items()
    }
    held = " ".join(_held(kind, *known) for kind, known in kinds.items())
    caption = f"Share of the variance that the first components explain together; the kept ones are blue. {held}"
    return Sketch(figure, tables, caption)


def _draw_bars(panel: Axes, energy: Floats, kept: int) -> None:
    shown = energy[:MOST_BARS]
    if not len(shown):
        write(panel, (0.5, 0.5), "nothing varies", transform=panel.transAxes, ha="center", color=QUIET)
        panel.set(xticks=[], yticks=[])
        return
    numbers = np.arange(1, len(shown) + 1)
    for chosen, colour, alpha in ((numbers <= kept, COLOURS[0], 1.0), (numbers > kept, REFERENCE, 0.35)):
        panel.bar(numbers[chosen], 100.0 * shown[chosen], width=0.8, color=colour, alpha=alpha)
    panel.set(xlim=(0.3, max(len(shown), 4) + 0.7), ylim=(0.0, 109.0))
    tick_whole_numbers(panel.xaxis)
    if kept:
        write(panel, (kept, 100.0 * shown[min(kept, len(shown)) - 1] + 1.0), f"{100.0 * energy[kept - 1]:.0f} %",
              ha="center", va="bottom", color=INK)  # fmt: skip


def _held(kind: str, energy: Floats, kept: int) -> str:
    if not len(energy):
        return f"The {kind} of the examples do not vary." if kind == "poses" else "Their time does not vary."
    lost = 100.0 * (1.0 - float(energy[kept - 1])) if kept else 100.0
    whose = "The poses of the examples" if kind == "poses" else "Their time"
    verb = "vary" if kind == "poses" else "varies"
    return (
        f"{whose} {verb} in {counted(len(energy), 'component')}; the model keeps {kept} of them, which explain "
        f"{100.0 - lost:.1f} % of the variance."
    )


def draw_reconstruction(subject: ModelSubject) -> Sketch | None:
    """Draw the error of rebuilt examples over the number of components; return None if it was not measured."""
    errors = subject.report.reconstruction
    if errors is None:
        return None
    kept = subject.primitive.spatial.count
    figure = new_figure(8.2, 3.6)
    panel = add_panel(figure, Place(0.75, 0.65, 5.2, 2.5), x="spatial components", y="mean distance of joints (cm)")
    low, high = np.quantile(errors.left_out_each_cm, (0.1, 0.9), axis=0)
    if len(errors.left_out_each_cm) > 1:
        panel.fill_between(
            errors.components, low, high, color=COLOURS[1], alpha=0.18, lw=0, label="80 % of left-out examples"
        )
        panel.plot(errors.components, errors.left_out_cm, color=COLOURS[1], marker="s", ms=3.5, lw=1.4,
                   label="left-out examples")  # fmt: skip
    panel.plot(errors.components, errors.training_cm, color=COLOURS[0], marker="o", ms=3.5, lw=1.4,
               label="training examples")  # fmt: skip
    panel.axvline(kept, color=QUIET, lw=0.9, ls=(0, (4, 3)))
    top = 1.15 * max(float(curve.max()) for curve in (high, errors.left_out_cm, errors.training_cm)) or 1.0
    panel.set(xlim=(-0.4, max(float(errors.components[-1]), 1.0) + 0.4), ylim=(0.0, top))
    write(panel, (kept, top), f" kept: {kept}", color=QUIET, va="top")
    tick_whole_numbers(panel.xaxis)
    add_keys(panel, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    at = min(kept, len(errors.components) - 1)
    caption = (
        "Error of examples that are reconstructed from the first components, by their number. With the "
        f"{counted(kept, 'kept component')}, the mean error is {errors.training_cm[at]:.1f} cm for training examples"
    )
    if len(errors.left_out_each_cm) > 1:
        caption += f", and {errors.left_out_cm[at]:.1f} cm for examples that were left out"
    tables: Tables = {
        "errors": {
            "components": errors.components,
            "training_cm": errors.training_cm,
            "left_out_cm": errors.left_out_cm,
        }
    }
    return Sketch(figure, tables, f"{caption}.")


def draw_criterion(subject: ModelSubject) -> Sketch | None:
    """Draw BIC and AIC over the number of mixture components; return None if the training did not compute them."""
    candidates = subject.report.candidates
    if not candidates:
        return None
    chosen = len(subject.primitive.mixture.weights)
    counts = np.array([each.components for each in candidates])
    figure = new_figure(6.9, 3.3)
    panel = add_panel(figure, Place(0.95, 0.65, 3.9, 2.3), x="normal distributions", y="BIC, AIC (lower is better)")
    for name, colour, marker in (("bic", COLOURS[0], "o"), ("aic", REFERENCE, "^")):
        values = np.array([getattr(each, name) for each in candidates])
        panel.plot(counts, values, color=colour, marker=marker, ms=4.5, lw=1.3, label=name.upper())
    refused = [each for each in candidates if each.refusal]
    if refused:
        panel.plot([each.components for each in refused], [each.bic for each in refused], ls="", marker="x", ms=9,
                   color=COLOURS[1], label="rejected")  # fmt: skip
    taken = next((each for each in candidates if each.components == chosen), None)
    if taken is not None:
        panel.plot([chosen], [taken.bic], ls="", marker="o", ms=11, mfc="none", mec=INK, label=f"used: {chosen}")
    tick_whole_numbers(panel.xaxis)
    panel.set_xlim(counts[0] - 0.5, counts[-1] + 0.5)
    add_keys(panel, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    tables: Tables = {
        "candidates": {
            "components": counts,
            "bic": [each.bic for each in candidates],
            "aic": [each.aic for each in candidates],
            "log_likelihood": [each.log_likelihood for each in candidates],
            "smallest_weight": [each.smallest_weight for each in candidates],
            "refusal": [each.refusal for each in candidates],
        }
    }
    caption = (
        f"Information criteria by the number of normal distributions in the mixture; the model uses {chosen}. Both "
        "weigh the fit against the number of parameters. A number is rejected if a distribution would have too few "
        "examples, or if it makes held-out examples no likelier than one distribution does."
    )
    return Sketch(figure, tables, caption)

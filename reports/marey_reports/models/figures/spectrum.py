"""Figures about numbers of components: explained variance, reconstruction error, and size of the mixture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.modelling.reconstruction import ReconstructionErrors
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
from marey_schemas.options.modelling import COVARIANCE_KINDS
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
    """Draw the error of reconstructed examples over the number of components; return None if no error was measured."""
    errors = subject.report.reconstruction
    if errors is None:
        return None
    kept = subject.primitive.spatial.count
    figure = new_figure(8.2, 3.6)
    panel = add_panel(figure, Place(0.75, 0.65, 5.2, 2.5), x="spatial components", y="mean distance of joints (cm)")
    curves = [errors.training_cm]
    if errors.left_out_cm is not None and errors.left_out_each_cm is not None:
        low, high = np.quantile(errors.left_out_each_cm, (0.1, 0.9), axis=0)
        curves += [high, errors.left_out_cm]
        panel.fill_between(
            errors.components, low, high, color=COLOURS[1], alpha=0.18, lw=0, label="80 % of left-out takes"
        )
        panel.plot(errors.components, errors.left_out_cm, color=COLOURS[1], marker="s", ms=3.5, lw=1.4,
                   label="left-out takes")  # fmt: skip
    panel.plot(errors.components, errors.training_cm, color=COLOURS[0], marker="o", ms=3.5, lw=1.4,
               label="training examples")  # fmt: skip
    by_subject = errors.left_out_subject_cm
    if by_subject is not None:
        curves.append(by_subject)
        panel.plot(errors.components, by_subject, color=COLOURS[2], marker="^", ms=3.5, lw=1.4,
                   label="left-out performers")  # fmt: skip
    panel.axvline(kept, color=QUIET, lw=0.9, ls=(0, (4, 3)))
    top = 1.15 * max(float(curve.max()) for curve in curves) or 1.0
    panel.set(xlim=(-0.4, max(float(errors.components[-1]), 1.0) + 0.4), ylim=(0.0, top))
    # Spaces would not keep text and line apart: SVG ignores a space at the beginning of a text.
    write(panel, (kept + 0.012 * float(np.ptp(panel.get_xlim())), 0.985 * top), f"kept: {kept}", color=QUIET, va="top")
    tick_whole_numbers(panel.xaxis)
    add_keys(panel, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    tables: Tables = {
        "errors": {
            "components": errors.components,
            "training_cm": errors.training_cm,
            **({} if errors.left_out_cm is None else {"left_out_cm": errors.left_out_cm}),
            **({} if by_subject is None else {"left_out_subject_cm": by_subject}),
        }
    }
    return Sketch(figure, tables, _reconstruction_caption(errors, kept))


def _reconstruction_caption(errors: ReconstructionErrors, kept: int) -> str:
    at = min(kept, len(errors.components) - 1)
    caption = (
        "Error of examples that are reconstructed from the first components, by their number. With the "
        f"{counted(kept, 'kept component')}, the mean error is {errors.training_cm[at]:.1f} cm for training examples"
    )
    if errors.left_out_cm is None:
        caption += "; that of other takes is unknown, because all examples come from one take"
    else:
        caption += f", and {errors.left_out_cm[at]:.1f} cm for examples whose take was left out"
    if errors.left_out_subject_cm is not None:
        caption += f" ({errors.left_out_subject_cm[at]:.1f} cm if their performer was left out)"
    return f"{caption}."


def draw_criterion(subject: ModelSubject) -> Sketch | None:
    """Draw held-out likelihood and BIC of the mixtures that were tried; return None if none were compared."""
    candidates = subject.report.candidates
    if not candidates:
        return None
    chosen, covariance = len(subject.primitive.mixture.weights), subject.report.mixture_covariance
    taken = [each for each in candidates if (each.components, each.covariance) == (chosen, covariance)]
    figure = new_figure(9.6, 3.3)
    measured = any(each.held_out_log_likelihood is not None for each in candidates)
    panels = [("held_out_log_likelihood", "log-likelihood of left-out takes (higher is better)")] if measured else []
    panels.append(("bic", "BIC (lower is better)"))
    drawn = []
    for place, (name, label) in enumerate(panels):
        panel = add_panel(figure, Place(0.95 + 3.9 * place, 0.65, 2.9, 2.3), x="normal distributions", y=label)
        for kind, colour, marker in zip(COVARIANCE_KINDS, COLOURS, "os^", strict=False):
            some = [each for each in candidates if each.covariance == kind and getattr(each, name) is not None]
            counts, values = [each.components for each in some], [getattr(each, name) for each in some]
            panel.plot(counts, values, color=colour, marker=marker, ms=4.5, lw=1.3, label=kind)
        values = [getattr(each, name) for each in taken if getattr(each, name) is not None]
        panel.plot(
            [chosen] * len(values), values, ls="", marker="o", ms=11, mfc="none", mec=INK, label=f"used: {chosen}"
        )
        tick_whole_numbers(panel.xaxis)
        drawn.append(panel)
        panel.set_xlim(0.5, max(each.components for each in candidates) + 0.5)
    add_keys(drawn[-1], loc="upper left", bbox_to_anchor=(1.02, 1.0))
    columns = (
        "components", "covariance", "held_out_log_likelihood", "bic", "aic", "log_likelihood", "smallest_weight",
        "refusal",
    )  # fmt: skip
    tables: Tables = {"candidates": {name: [getattr(each, name) for each in candidates] for name in columns}}
    caption = (
        "Mixtures that were tried, by their number of normal distributions and the kind of their covariances; the "
        f"model uses {counted(chosen, 'normal distribution')} ({covariance} covariance). If mixtures fit left-out "
        "takes equally well, the simplest is used. Mixtures in which a distribution has fewer than 5 examples are not "
        "used. BIC weighs the fit against the number of parameters."
    )
    return Sketch(figure, tables, caption)

"""Figures of the examples of a model: their positions in latent space, and their likelihoods."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.modelling.training_report import DEVIATION_OF_MEDIAN, OUTLIER_DEVIATIONS, ExampleReport
from marey_reports.drawing.drawn import Sketch, Tables
from marey_reports.drawing.paper import (
    COLOURS,
    PAPER,
    QUIET,
    REFERENCE,
    SIDE,
    Place,
    add_keys,
    add_panel,
    name_ticks,
    new_figure,
    write,
)
from marey_reports.models.figures.subjects import ModelSubject
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes


SCATTERED_SAMPLES = 400
ELLIPSE_DEVIATIONS = 2.0
NAMED = 12
MOST_ROWS = 30
ROW = 0.2
FARTHEST = 20.0
"""Greatest distance below the median, in robust standard deviations, that is drawn to scale."""


def draw_latent_space(subject: ModelSubject) -> Sketch | None:
    """Draw examples, samples and the mixture in pairs of latent dimensions; return None if there is no pair."""
    primitive = subject.primitive
    pairs = _pairs(primitive.spatial.count, primitive.temporal.count)
    if not pairs:
        return None
    samples = primitive.sample(SCATTERED_SAMPLES, subject.seed)
    figure = new_figure(max(0.3 + len(pairs) * (SIDE + 0.75), 5.6), SIDE + 1.35)
    for place, pair in enumerate(pairs):
        names = [_axis(primitive.spatial.count, dimension) for dimension in pair]
        panel = add_panel(figure, Place(0.75 + place * (SIDE + 0.75), 0.65, SIDE, SIDE), x=names[0], y=names[1])
        _draw_pair(panel, subject, samples, pair)
        if place == 0:
            add_keys(panel, loc="lower left", bbox_to_anchor=(-0.03, 1.0), ncols=4, columnspacing=1.2)
    components = len(primitive.mixture.weights)
    odd = [example.name for example in subject.report.examples if example.outlier]
    caption = (
        f"The examples and {SCATTERED_SAMPLES} samples in the latent space of the model; samples are drawn from "
        f"{counted(components, 'normal distribution')} (outlines at two standard deviations). "
        f"{_sentence_about_outliers(len(odd))}"
    )
    tables: Tables = {
        "examples": {
            "example": [clip.uid for clip in subject.examples.clips],
            **{
                _axis(primitive.spatial.count, place): subject.latents[:, place]
                for place in range(primitive.dimensions)
            },
        },
        "samples": {_axis(primitive.spatial.count, place): samples[:, place] for place in range(primitive.dimensions)},
    }
    return Sketch(figure, tables, caption)


def _sentence_about_outliers(count: int) -> str:
    if not count:
        return "No example is unusual."
    return f"Crosses mark {counted(count, 'unusual example')}."


def _pairs(spatial: int, temporal: int) -> list[tuple[int, int]]:
    """Choose at most three pairs of latent dimensions to draw.

    The first spatial component is paired with the second and third one and with the first temporal component. If there
    is no such pair, the first two temporal components are drawn.
    """
    pairs = [(0, 1)] if spatial > 1 else []
    if spatial > 2:
        pairs.append((0, 2))
    if temporal and spatial:
        pairs.append((0, spatial))
    if temporal > 1 and not pairs:
        pairs.append((0, 1))
    return pairs


def _axis(spatial: int, dimension: int) -> str:
    return f"poses {dimension + 1}" if dimension < spatial else f"time {dimension - spatial + 1}"


def _draw_pair(panel: Axes, subject: ModelSubject, samples: Floats, pair: tuple[int, int]) -> None:
    x, y = pair
    mixture, latents = subject.primitive.mixture, subject.latents
    panel.plot(samples[:, x], samples[:, y], ls="", marker=".", ms=2.2, color=REFERENCE, alpha=0.6, label="samples",
               rasterized=True)  # fmt: skip
    for number, (mean, covariance) in enumerate(zip(mixture.means, mixture.covariances, strict=True)):
        outline = ellipse(mean[[x, y]], covariance[np.ix_(pair, pair)])
        panel.plot(outline[:, 0], outline[:, 1], color=COLOURS[1], lw=1.2, label=None if number else "mixture")
    odd = np.array([example.outlier for example in subject.report.examples], dtype=bool)
    for chosen, marker, label in ((~odd, "o", "examples"), (odd, "X", "unusual examples")):
        if chosen.any():
            size = 5.0 if marker == "o" else 8.0
            panel.plot(latents[chosen, x], latents[chosen, y], ls="", marker=marker, ms=size, mfc=COLOURS[0],
                       mec=PAPER, mew=0.6, label=label)  # fmt: skip
    panel.margins(0.06)


def ellipse(mean: Floats, covariance: Floats) -> Floats:
    """Compute the ellipse (60, 2) at two standard deviations of a normal distribution in a plane."""
    values, vectors = np.linalg.eigh(covariance)
    angles = np.linspace(0.0, 2.0 * np.pi, 60)
    circle = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return np.asarray(mean + ELLIPSE_DEVIATIONS * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def draw_likelihood(subject: ModelSubject) -> Sketch:
    """Draw the likelihoods of the examples, the least likely first."""
    examples = subject.report.examples
    order = sorted(range(len(examples)), key=lambda place: (_judged(examples[place]), examples[place].uid))
    below = _deviations(np.array([_judged(example) for example in examples]))
    shown = order[:MOST_ROWS]
    figure = new_figure(8.8, ROW * len(shown) + 0.95)
    label = "log-likelihood, as deviation from the median (robust standard deviations)"
    panel = add_panel(figure, Place(3.0, 0.65, 5.6, ROW * len(shown)), x=label)
    values, rows = below[shown], np.arange(len(shown))
    drawn = np.maximum(values, -FARTHEST)
    odd = np.array([examples[place].outlier for place in shown], dtype=bool)
    panel.hlines(rows, 0.0, drawn, color=REFERENCE, lw=1.0)
    for chosen, colour, marker in (
        (~odd, COLOURS[0], "o"),
        (odd & (values >= -FARTHEST), COLOURS[1], "X"),
        (odd & (values < -FARTHEST), COLOURS[1], "<"),
    ):
        panel.plot(drawn[chosen], rows[chosen], ls="", marker=marker, ms=6, color=colour, mec=PAPER, mew=0.5)
    for row in np.flatnonzero(values < -FARTHEST):
        write(panel, (drawn[row] + 0.4, rows[row] - 0.02), f"{values[row]:.0f}", color=QUIET, va="bottom")
    panel.axvline(-OUTLIER_DEVIATIONS, color=QUIET, lw=0.9, ls=(0, (4, 3)))
    name_ticks(panel, rows.tolist(), [subject.names[place] for place in shown])
    panel.set(xlim=(-FARTHEST - 1.0, max(2.5, 1.1 * float(drawn.max()))), ylim=(len(shown) - 0.4, -0.6))
    tables: Tables = {
        "examples": {
            "example": [examples[place].uid for place in order],
            "name": [examples[place].name for place in order],
            "log_likelihood": [examples[place].log_likelihood for place in order],
            "held_out_log_likelihood": [examples[place].held_out_log_likelihood for place in order],
            "robust_deviations": below[order],
            "outlier": [examples[place].outlier for place in order],
        }
    }
    odd_ones = [place for place in order if examples[place].outlier]
    return Sketch(figure, tables, _likelihood_caption(subject, odd_ones, len(order) - len(shown)))


def _deviations(judged: Floats) -> Floats:
    """Convert log-likelihoods to robust standard deviations from the median; 0 if the log-likelihoods do not differ."""
    away = judged - np.median(judged)
    spread = DEVIATION_OF_MEDIAN * float(np.median(np.abs(away)))
    return np.asarray(away / spread if spread > 0.0 else np.zeros(len(judged)), dtype=np.float64)


def _judged(example: ExampleReport) -> float:
    """Return the log-likelihood by which an example is judged unusual: the held-out value if it was computed."""
    held_out = example.held_out_log_likelihood
    return example.log_likelihood if held_out is None else held_out


def _likelihood_caption(subject: ModelSubject, odd: list[int], hidden: int) -> str:
    start = (
        "Log-likelihood of each example, the lowest at the top. Examples to the left of the dashed line are unusual"
        f"{f'; the {hidden} likeliest are not shown' if hidden else ''}."
    )
    if not odd:
        return f"{start} There are none."
    named = ", ".join(subject.names[place] for place in odd[:NAMED])
    more = f" and {len(odd) - NAMED} more" if len(odd) > NAMED else ""
    return f"{start} Check whether these show the same action as the others: {named}{more}."

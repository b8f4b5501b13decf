"""The examples as the model sees them: where they lie in its latent space, and how likely each of them is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from marey_motion.drawing.drawn import Sketch, Tables
from marey_motion.drawing.paper import (
    COLOURS,
    INK,
    PAPER,
    QUIET,
    REFERENCE,
    Place,
    add_keys,
    add_panel,
    new_figure,
    plain,
    shortened,
    write,
)
from marey_motion.drawing.words import amount
from marey_motion.modelling.figures.subjects import ModelSubject
from marey_motion.modelling.training_report import ExampleReport

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

SCATTERED_SAMPLES = 400
ELLIPSE_DEVIATIONS = 2.0
SIDE = 2.7
NAMED = 12
MOST_ROWS = 30
ROW = 0.2


def draw_latent_space(subject: ModelSubject) -> Sketch | None:
    """Examples, samples and the mixture in pairs of latent dimensions; None where there are none."""
    primitive = subject.primitive
    pairs = _pairs(primitive.spatial.count, primitive.temporal.count)
    if not pairs:
        return None
    samples = primitive.sample(SCATTERED_SAMPLES, subject.seed)
    figure = new_figure(0.3 + len(pairs) * (SIDE + 0.75), SIDE + 1.35)
    for place, pair in enumerate(pairs):
        names = [_axis(primitive.spatial.count, dimension) for dimension in pair]
        panel = add_panel(figure, Place(0.75 + place * (SIDE + 0.75), 0.65, SIDE, SIDE), x=names[0], y=names[1])
        _draw_pair(panel, subject, samples, pair)
        if place == 0:
            add_keys(panel, loc="lower left", bbox_to_anchor=(-0.03, 1.0), ncols=4, columnspacing=1.2)
    components = len(primitive.mixture.weights)
    odd = [example.name for example in subject.report.examples if example.outlier]
    caption = (
        f"Each example as a point in the latent space of the model, with {SCATTERED_SAMPLES} samples; {_mixture(components)} "
        f"(outlines hold two standard deviations). {_odd_ones(len(odd))}"
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


def _mixture(components: int) -> str:
    return (
        "the model draws them from one normal distribution"
        if components == 1
        else f"the model draws them from {components} normal distributions"
    )


def _odd_ones(count: int) -> str:
    if not count:
        return "No example stands apart from the others."
    return f"{amount(count, 'example')} {'stands' if count == 1 else 'stand'} apart from the others, marked by a cross."


def _pairs(spatial: int, temporal: int) -> list[tuple[int, int]]:
    """At most three pairs: the first poses against each other, and the first of time."""
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
    for chosen, marker, label in ((~odd, "o", "examples"), (odd, "X", "odd examples")):
        if chosen.any():
            size = 5.0 if marker == "o" else 8.0
            panel.plot(latents[chosen, x], latents[chosen, y], ls="", marker=marker, ms=size, mfc=COLOURS[0],
                       mec=PAPER, mew=0.6, label=label)  # fmt: skip
    panel.margins(0.06)


def ellipse(mean: Floats, covariance: Floats) -> Floats:
    """(60, 2) the outline that holds two standard deviations of a normal distribution in a plane."""
    values, vectors = np.linalg.eigh(covariance)
    angles = np.linspace(0.0, 2.0 * np.pi, 60)
    circle = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return np.asarray(mean + ELLIPSE_DEVIATIONS * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def draw_likelihood(subject: ModelSubject) -> Sketch:
    """How likely each example is, the least likely first."""
    examples = subject.report.examples
    order = sorted(range(len(examples)), key=lambda place: (_judged(examples[place]), examples[place].uid))
    shown = order[:MOST_ROWS]
    figure = new_figure(8.4, ROW * len(shown) + 1.35)
    panel = add_panel(figure, Place(2.7, 0.65, 3.6, ROW * len(shown)), x="log-likelihood", y="")
    rows = np.arange(len(shown))
    own = np.array([examples[place].log_likelihood for place in shown])
    held_out = [examples[place].held_out_log_likelihood for place in shown]
    odd = np.array([examples[place].outlier for place in shown], dtype=bool)
    if None not in held_out:
        panel.hlines(rows, np.array(held_out, dtype=np.float64), own, color=REFERENCE, lw=0.9)
        panel.plot(held_out, rows, ls="", marker="s", ms=4.5, color=COLOURS[1], label="by a mixture without it")
    panel.plot(own, rows, ls="", marker="o", ms=4.5, color=COLOURS[0], label="by the model")
    if odd.any():
        panel.plot(own[odd], rows[odd], ls="", marker="o", ms=10, mfc="none", mec=INK, label="odd")
    names = [plain(shortened(subject.names[place], 34)) for place in shown]
    panel.set_yticks(rows, names, parse_math=False)
    panel.tick_params(axis="y", length=0, labelcolor=INK)
    panel.set_ylim(len(shown) - 0.4, -0.6)
    add_keys(panel, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    if len(order) > len(shown):
        write(panel, (1.04, 0.0), f"{len(order) - len(shown)} likelier ones\nare not shown", transform=panel.transAxes,
              color=QUIET, va="bottom")  # fmt: skip
    tables: Tables = {
        "examples": {
            "example": [examples[place].uid for place in order],
            "name": [examples[place].name for place in order],
            "log_likelihood": [examples[place].log_likelihood for place in order],
            "held_out_log_likelihood": [examples[place].held_out_log_likelihood for place in order],
            "outlier": [examples[place].outlier for place in order],
        }
    }
    return Sketch(figure, tables, _likelihood_caption(subject, [place for place in order if examples[place].outlier]))


def _judged(example: ExampleReport) -> float:
    """The likelihood that tells odd examples."""
    held_out = example.held_out_log_likelihood
    return example.log_likelihood if held_out is None else held_out


def _likelihood_caption(subject: ModelSubject, odd: list[int]) -> str:
    start = (
        "How well each example fits what the model expects, the worst at the top. Squares come from mixtures that "
        "were fitted without the example."
    )
    if not odd:
        return f"{start} None falls out of the ordinary."
    named = ", ".join(subject.names[place] for place in odd[:NAMED])
    more = f" and {len(odd) - NAMED} more" if len(odd) > NAMED else ""
    return f"{start} Out of the ordinary: {named}{more}. Look whether they show the same action as the others."

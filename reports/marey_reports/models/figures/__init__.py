"""Figures of a model: alignment and reconstruction of its examples, its samples, and its quality.

matplotlib is loaded when the first figure is drawn. The same model and examples give the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from marey_motion.alignment.aligned import AlignedSet
from marey_reports.drawing.drawn import DrawnFigure, Sketch
from marey_reports.models.figures.alignment_costs import draw_alignment_costs
from marey_reports.models.figures.components import draw_component, draw_mean
from marey_reports.models.figures.latent_space import draw_latent_space, draw_likelihood
from marey_reports.models.figures.samples import draw_paths, draw_samples
from marey_reports.models.figures.search_errors import draw_search_check, draw_search_errors
from marey_reports.models.figures.spectrum import draw_criterion, draw_reconstruction, draw_variance
from marey_reports.models.figures.subjects import ModelSubject
from marey_reports.models.figures.time_warps import draw_time_warps
from marey_reports.models.figures.timing import draw_durations, draw_time_components

__all__ = ["DrawnFigure", "ModelSubject", "draw_alignment_figures", "draw_model_figures", "draw_search_errors"]

SWEPT_COMPONENTS = 3

ALIGNMENT_FIGURES: dict[str, tuple[str, Callable[[AlignedSet], Sketch | None]]] = {
    "time-warps": ("Alignment in time", draw_time_warps),
    "alignment-costs": ("Costs of the alignment", draw_alignment_costs),
}
MODEL_FIGURES: dict[str, tuple[str, Callable[[ModelSubject], Sketch | None]]] = {
    "mean": ("Mean motion", draw_mean),
    "samples": ("Examples and samples", draw_samples),
    "paths": ("Trajectories of hands and feet", draw_paths),
    "search-errors": ("Errors at search targets", draw_search_check),
    "durations": ("Durations", draw_durations),
    "time-components": ("Time components", draw_time_components),
    "variance": ("Variance of the components", draw_variance),
    "reconstruction": ("Reconstruction error", draw_reconstruction),
    "latent-space": ("Latent space", draw_latent_space),
    "mixture": ("Choice of the mixture", draw_criterion),
    "likelihood": ("Likelihood of the examples", draw_likelihood),
}
"""Title and drawing function of each figure, by its name. Figures whose function returns None are left out."""

PUBLISHED = {"samples": "17"}
"""Numbers of figures in Herrmann et al. (2019), by the name of the figure."""


def draw_alignment_figures(aligned: AlignedSet) -> dict[str, DrawnFigure]:
    """Draw every figure of an alignment, by name."""
    return _drawn({name: (title, partial(draw, aligned)) for name, (title, draw) in ALIGNMENT_FIGURES.items()})


def draw_model_figures(subject: ModelSubject) -> dict[str, DrawnFigure]:
    """Draw every figure of a model, by name; components are named `component-1` and so on."""
    swept = {
        f"component-{number + 1}": (f"Component {number + 1} of the poses", partial(draw_component, subject, number))
        for number in range(min(SWEPT_COMPONENTS, subject.primitive.spatial.count))
    }
    return _drawn(swept | {name: (title, partial(draw, subject)) for name, (title, draw) in MODEL_FIGURES.items()})


def _drawn(makers: dict[str, tuple[str, Callable[[], Sketch | None]]]) -> dict[str, DrawnFigure]:
    sketches = {name: (title, draw()) for name, (title, draw) in makers.items()}
    return {
        name: DrawnFigure(sketch, name, PUBLISHED.get(name, ""), title)
        for name, (title, sketch) in sketches.items()
        if sketch is not None
    }

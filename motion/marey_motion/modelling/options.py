"""Options of training a model."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal, get_args

from marey_motion.errors import ModelError
from marey_motion.modelling.fpca import InnerProduct

Scaling = Literal["jacobian", "root_max", "sfpca", "none"]
Criterion = Literal["bic", "aic"]


@dataclass(frozen=True)
class ModelOptions:
    """Options of `train_primitive`; the defaults of docs/explanation/models.md.

    Parameters
    ----------
    scaling : of channels before the analysis. jacobian: all in metres by the lever arms of the joints; root_max: root
        axes to a maximum of 1; sfpca: optimised for the positions of joints (Du et al. 2016); none
    inner_product : of spatial functions; see `fpca.find_components`. That of time functions is always l2.
    spatial_share : of the variance that the spatial components hold
    spatial_components : exactly so many, in place of the share
    spatial_coefficients : of each channel's spline; by the number of frames if None
    temporal_share, most_temporal_components : the time components hold the share, but are at most so many
    temporal_coefficients : of the time function's spline
    temporal_weight : of time scores in latent vectors; None gives them the variance of the spatial ones
    criterion, most_mixture_components, mixture_components, regularisation, starts : see `mixture_fitting`
    leave_one_out : measure the reconstruction of each example by the others
    folds : of the held-out likelihood; 0 leaves it out
    report_samples : drawn to measure feet and durations
    """

    scaling: Scaling = "jacobian"
    inner_product: InnerProduct = "coefficients"
    spatial_share: float = 0.95
    spatial_components: int | None = None
    spatial_coefficients: int | None = None
    temporal_share: float = 0.99
    most_temporal_components: int = 3
    temporal_coefficients: int = 8
    temporal_weight: float | None = None
    criterion: Criterion = "bic"
    most_mixture_components: int = 10
    mixture_components: int | None = None
    regularisation: float = 1e-4
    starts: int = 5
    leave_one_out: bool = True
    folds: int = 5
    report_samples: int = 200

    def __post_init__(self) -> None:
        for name, allowed in (("scaling", Scaling), ("inner_product", InnerProduct), ("criterion", Criterion)):
            if getattr(self, name) not in get_args(allowed):
                raise ModelError(f"{getattr(self, name)!r} is none of {', '.join(get_args(allowed))}", where=name)
        for name, (least, most) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and least <= value <= most):
                raise ModelError(f"{value} is not between {least:g} and {most:g}", where=name)

    def as_tree(self) -> dict[str, str | float | int | bool | None]:
        """Convert the options to plain values.

        Returns
        -------
        dict    value by name
        """
        return {field.name: getattr(self, field.name) for field in fields(self)}


_RANGES: dict[str, tuple[float, float]] = {
    "spatial_share": (0.01, 1.0),
    "spatial_components": (0, 1000),
    "spatial_coefficients": (4, 10_000),
    "temporal_share": (0.01, 1.0),
    "most_temporal_components": (0, 1000),
    "temporal_coefficients": (4, 1000),
    "temporal_weight": (1e-3, 1e3),
    "most_mixture_components": (1, 100),
    "mixture_components": (1, 100),
    "regularisation": (1e-12, 1.0),
    "starts": (1, 100),
    "folds": (0, 100),
    "report_samples": (0, 10_000),
}

DEFAULT_OPTIONS = ModelOptions()
"""What models are trained with unless something else is asked for."""

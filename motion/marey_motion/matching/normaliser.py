"""Normalisation of features of different units to one scale."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.matching.features import FeatureLayout
from marey_schemas.encoding.digests import digest_of_hash

LEAST_SCALE = 1e-3
"""Least scale of a feature: smaller scales are raised, so that a feature without variation does not dominate."""
UNMATCHED_SCALE = 1e30
"""Scale of groups with weight 0."""


@dataclass(frozen=True, eq=False)
class Normaliser:
    """Offset and scale of each feature dimension, identified by a digest.

    Parameters
    ----------
    offset, scale : (D,) float64    `apply` gives (features - offset) / scale; weights are part of the scale
    fitted_on : str    digest of the data to which the normaliser was fitted
    names : tuple of str    names of the D dimensions; empty when they are not known
    floored : tuple of str    groups whose scale was raised to `LEAST_SCALE`
    """

    offset: NDArray[np.float64]
    scale: NDArray[np.float64]
    fitted_on: str
    names: tuple[str, ...] = ()
    floored: tuple[str, ...] = ()

    def apply(self, features: Floats) -> Floats:
        """Normalise features.

        Parameters
        ----------
        features : (..., D) float64    metres, metres per second

        Returns
        -------
        (..., D) float64    without a unit; costs are squared distances between such rows
        """
        normalised = features - self.offset
        normalised /= self.scale
        return normalised

    @property
    def digest(self) -> str:
        """Digest of dimensions, offsets and scales, "sha256:…"."""
        content = hashlib.sha256(json.dumps(self.names).encode())
        for values in (self.offset, self.scale):
            content.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
        return digest_of_hash(content)

    def require_fit(self, layout: FeatureLayout) -> None:
        """Check that this normaliser fits the dimensions of a layout.

        Parameters
        ----------
        layout : FeatureLayout    D dimensions

        Raises
        ------
        MotionError    if the number or the names of the dimensions differ
        """
        if len(self.offset) != layout.dimension_count:
            raise MotionError(
                f"the normaliser has {len(self.offset)} dimensions, but the features have "
                f"{layout.dimension_count}; use a normaliser that was fitted with the same joints and horizons",
                code="normaliser-mismatch",
                where="normaliser",
            )
        different = [pair for pair in zip(self.names, layout.names, strict=False) if pair[0] != pair[1]]
        if different:
            raise MotionError(
                f"the normaliser has the feature {different[0][0]} where the database has {different[0][1]}; "
                "use a normaliser that was fitted with the same joints and horizons",
                code="normaliser-mismatch",
                where="normaliser",
            )

    def as_tree(self) -> dict[str, Any]:
        """Convert the normaliser to plain values and arrays, which `from_tree` reads.

        Returns
        -------
        dict    plain values and arrays
        """
        return {
            "digest": self.digest,
            "fitted_on": self.fitted_on,
            "names": list(self.names),
            "floored": list(self.floored),
            "offset": np.asarray(self.offset),
            "scale": np.asarray(self.scale),
        }

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> Normaliser:
        """Convert the result of `as_tree` to a normaliser.

        Parameters
        ----------
        tree : mapping    plain values and arrays

        Returns
        -------
        Normaliser    the same normaliser

        Raises
        ------
        MotionError    if a member is missing or invalid, or if the numbers were changed after the digest was computed
        """
        try:
            offset, scale = (np.asarray(tree[name], dtype=np.float64) for name in ("offset", "scale"))
            names, floored = tuple(tree["names"]), tuple(tree["floored"])
            fitted_on, digest = str(tree["fitted_on"]), str(tree["digest"])
        except (KeyError, TypeError, ValueError) as error:
            raise MotionError(
                f"the document is not a valid normaliser: {error}", code="normaliser-invalid", where="normaliser"
            ) from error
        if offset.ndim != 1 or scale.shape != offset.shape or len(names) not in (0, len(offset)):
            raise MotionError(
                f"{len(names)} names, offsets of the shape {offset.shape} and scales of the shape "
                f"{scale.shape} do not match; each name needs one offset and one scale",
                code="normaliser-invalid",
                where="normaliser",
            )
        if not np.all(np.isfinite(offset)) or not np.all(np.isfinite(scale) & (scale > 0.0)):
            raise MotionError(
                "the offsets must be finite, and the scales finite and positive",
                code="normaliser-invalid",
                where="normaliser",
            )
        result = cls(offset, scale, fitted_on, names, floored)
        if result.digest != digest:
            raise MotionError(
                f"the numbers of the normaliser were changed: their digest is {result.digest}, not {digest}; use an "
                "unchanged copy",
                code="normaliser-invalid",
                where="normaliser",
            )
        return result


def fit_normaliser(features: Floats, layout: FeatureLayout, fitted_on: str) -> Normaliser:
    """Fit an offset for each dimension and a scale for each group of dimensions.

    The offset is the mean. The scale is the mean of the standard deviations of the group's dimensions, divided by the
    weight of the group. Groups that hardly vary get the scale `LEAST_SCALE`, and are listed in `floored`. Groups with
    the weight 0 get the scale `UNMATCHED_SCALE`.

    Parameters
    ----------
    features : (N, D) float64    before normalisation
    layout : FeatureLayout    groups and weights of the D dimensions
    fitted_on : str    digest of the data

    Returns
    -------
    Normaliser    offset and scale

    Raises
    ------
    MotionError    if there are no rows
    """
    if not len(features):
        raise MotionError("a normaliser needs at least one row of features, but none was given", code="no-features")
    offset = features.mean(axis=0)
    deviations = np.array([features[:, d].std() for d in range(layout.dimension_count)])
    scale = np.empty(layout.dimension_count)
    floored = []
    for group in layout.groups:
        spread = float(deviations[group.start : group.stop].mean())
        wanted = spread / group.weight if group.weight > 0.0 else UNMATCHED_SCALE
        if wanted < LEAST_SCALE:
            floored.append(group.name)
        scale[group.start : group.stop] = max(wanted, LEAST_SCALE)
    return Normaliser(offset, scale, fitted_on, layout.names, tuple(floored))

"""Conversion of motion primitives and their training reports to and from plain values and arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import ModelError
from marey_motion.modelling.mixture import LatentMixture
from marey_motion.modelling.primitive import FunctionalComponents, MotionPrimitive
from marey_motion.modelling.splines import DEGREE, SplineBasis
from marey_motion.modelling.training import TrainedPrimitive
from marey_motion.modelling.training_report import TrainingReport
from marey_motion.modelling.verdict import headline_of, verdict_of
from marey_motion.skeleton import Skeleton

PRIMITIVE_SCHEMA = "marey/motion-primitive@1"

Tree = dict[str, Any]


def primitive_to_tree(primitive: MotionPrimitive, skeleton: Mapping[str, Any]) -> Tree:
    """Convert a primitive to the document that is stored as the part `model`.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    skeleton : mapping    reference to the revision of the primitive's skeleton

    Returns
    -------
    dict    plain values and arrays
    """
    return {
        "schema": PRIMITIVE_SCHEMA,
        "name": primitive.name,
        "skeleton": dict(skeleton),
        "joints": list(primitive.skeleton.joint_names),
        "frame_rate_hz": primitive.frame_rate_hz,
        "spatial": _components_to_tree(primitive.spatial),
        "temporal": _components_to_tree(primitive.temporal),
        "temporal_weight": primitive.temporal_weight,
        "mixture": {
            "weights": _leaf(primitive.mixture.weights),
            "means": _leaf(primitive.mixture.means),
            "covariances": _leaf(primitive.mixture.covariances),
        },
        "keyframes": {label: int(frame) for label, frame in primitive.keyframes.items()},
        "duration_range_s": _range_leaf(primitive.duration_range_s),
        "log_slope_range": _range_leaf(primitive.log_slope_range),
        "widening": primitive.widening,
    }


def trained_to_tree(trained: TrainedPrimitive, skeleton: Mapping[str, Any], provenance: Mapping[str, Any]) -> Tree:
    """Convert a trained primitive with its options and its report to the document that is stored as the part `model`.

    Parameters
    ----------
    trained : TrainedPrimitive    the model with its report
    skeleton : mapping    reference to the revision of the primitive's skeleton
    provenance : mapping    origin of the examples

    Returns
    -------
    dict    plain values and arrays
    """
    return {
        **primitive_to_tree(trained.primitive, skeleton),
        "verdict": verdict_of(trained),
        "headline": headline_of(trained),
        "scaling": {"method": trained.options.scaling, "weights": _leaf(trained.weights)},
        "options": trained.options.model_dump(),
        "provenance": dict(provenance),
        "training": {
            **_report_to_tree(trained.report),
            "warnings": [asdict(warning) for warning in trained.warnings],
        },
    }


def primitive_from_tree(tree: Mapping[str, Any], skeleton: Skeleton) -> MotionPrimitive:
    """Read the primitive of a part `model`; the primitive's joints must be those of the skeleton, in any order.

    Parameters
    ----------
    tree : mapping    plain values and arrays
    skeleton : Skeleton    skeleton of the primitive

    Returns
    -------
    MotionPrimitive    the model

    Raises
    ------
    ModelError    if the schema or the joints differ
    MotionError    if the numbers describe no model
    """
    if tree.get("schema") != PRIMITIVE_SCHEMA:
        raise ModelError(
            f"the document has the schema {tree.get('schema')!r}, not {PRIMITIVE_SCHEMA!r}; choose a model, or update "
            "Marey if a newer version made the document"
        )
    return MotionPrimitive(
        name=tree["name"],
        skeleton=skeleton,
        frame_rate_hz=float(tree["frame_rate_hz"]),
        spatial=_components_from_tree(tree["spatial"], _columns(tree["joints"], skeleton)),
        temporal=_components_from_tree(tree["temporal"], None),
        temporal_weight=float(tree["temporal_weight"]),
        mixture=LatentMixture(**{name: np.asarray(tree["mixture"][name]) for name in _MIXTURE}),
        keyframes=dict(tree.get("keyframes") or {}),
        duration_range_s=_range_of(tree, "duration_range_s"),
        log_slope_range=_range_of(tree, "log_slope_range"),
        widening=float(tree.get("widening", 1.0)),
    )


_MIXTURE = ("weights", "means", "covariances")
_COMPONENTS = ("mean", "directions", "projections", "variances", "energy")


def _components_to_tree(components: FunctionalComponents) -> Tree:
    return {
        "degree": components.basis.degree,
        "knots": _leaf(components.basis.knots),
        **{name: _leaf(getattr(components, name)) for name in _COMPONENTS},
    }


def _components_from_tree(tree: Mapping[str, Any], columns: NDArray[np.int64] | None) -> FunctionalComponents:
    """Read components from a document. `columns` selects and orders the channels; None keeps all in the same order."""
    arrays = {name: np.asarray(tree[name]) for name in _COMPONENTS}
    if columns is not None:
        for name in ("mean", "directions", "projections"):
            arrays[name] = np.ascontiguousarray(arrays[name][..., columns])
    return FunctionalComponents(basis=SplineBasis(np.asarray(tree["knots"]), int(tree.get("degree", DEGREE))), **arrays)


def _columns(joints: list[str], skeleton: Skeleton) -> NDArray[np.int64] | None:
    """Return the index in a document of each channel of the skeleton; None if the document has the same order."""
    if tuple(joints) == skeleton.joint_names:
        return None
    if sorted(joints) != sorted(skeleton.joint_names) or joints[0] != skeleton.joint_names[0]:
        odd = sorted(set(joints) ^ set(skeleton.joint_names)) or ["the root, or a name that appears twice"]
        raise ModelError(
            f"the joints of the model and the skeleton differ: {', '.join(odd[:5])}; use the skeleton for which the "
            "model was made",
            where="joints",
        )
    places = {name: place for place, name in enumerate(joints)}
    order = np.array([places[name] for name in skeleton.joint_names])
    return np.concatenate((np.arange(3), (3 + 4 * order[:, None] + np.arange(4)).ravel()))


def _report_to_tree(report: TrainingReport) -> Tree:
    errors = report.reconstruction
    return {
        "spatial_energy": _leaf(report.spatial_energy),
        "temporal_energy": _leaf(report.temporal_energy),
        "takes": report.takes,
        "subjects": report.subjects,
        "mixture_covariance": report.mixture_covariance,
        "candidates": [asdict(one) for one in report.candidates],
        "log_likelihood": report.log_likelihood,
        "held_out_log_likelihood": report.held_out_log_likelihood,
        "held_out_low_share": report.held_out_low_share,
        "held_out_subject_log_likelihood": report.held_out_subject_log_likelihood,
        "held_out_subject_low_share": report.held_out_subject_low_share,
        "examples": [asdict(one) for one in report.examples],
        "reconstruction": None
        if errors is None
        else {name: np.asarray(value) for name, value in vars(errors).items() if value is not None},
        "time_error_frames": report.time_error_frames,
        "training_durations": asdict(report.training_durations),
        "sample_durations": None if report.sample_durations is None else asdict(report.sample_durations),
        "training_feet": None if report.training_feet is None else asdict(report.training_feet),
        "sample_feet": None if report.sample_feet is None else asdict(report.sample_feet),
        "comparison": None if report.comparison is None else asdict(report.comparison),
    }


def _range_leaf(limits: tuple[float, float] | None) -> list[float] | None:
    return None if limits is None else list(limits)


def _range_of(tree: Mapping[str, Any], name: str) -> tuple[float, float] | None:
    limits = tree.get(name)
    return None if limits is None else (float(limits[0]), float(limits[1]))


def _leaf(array: Floats) -> Floats:
    return np.ascontiguousarray(array, dtype=np.float64)

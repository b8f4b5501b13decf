"""Writer of motion primitives in layouts 3 and 2 of Marey's predecessor.

The documents are right-handed, with lengths in centimetres and times in canonical frames. The spatial part is written
exactly. A document of layout 2 can contain both forms of time functions (see `time_functions`), a document of layout 3
only the form `coefficients`. A time function that was read from a document of the predecessor is written as it was read
if the layout can contain its form. Other time functions are converted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.formats.predecessor.encoding import Encoding, encode_document
from marey_motion.formats.predecessor.model import columns_of
from marey_motion.formats.predecessor.skeleton import CENTIMETRE_M, skeleton_document
from marey_motion.formats.predecessor.time_functions import PredecessorTime, as_coefficients, as_increments
from marey_motion.modelling.mixture import LatentMixture
from marey_motion.modelling.primitive import MotionPrimitive


def write_predecessor_model(
    primitive: MotionPrimitive,
    *,
    layout: Literal["2", "3"] = "3",
    animated_joints: tuple[str, ...] = (),
    time: PredecessorTime | None = None,
    encoding: Encoding = "json",
) -> bytes:
    """Write a motion primitive as a model document of Marey's predecessor.

    A primitive without components gets a component of zeros, because the predecessor's reader rejects a mixture with
    zero dimensions.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    layout : str    "2" or "3"
    animated_joints : tuple of str    joints whose rotations are written; all joints if empty
    time : PredecessorTime, optional    the time function from which that of the primitive was converted
    encoding : str    "json", "bson" or "bson.bz2"

    Returns
    -------
    bytes    content of the file
    """
    joints = animated_joints or primitive.skeleton.joint_names
    written = primitive if primitive.dimensions else _with_idle_component(primitive)
    document = (
        _layered_document(written, joints, time if time is not None and time.form == "coefficients" else None)
        if layout == "3"
        else _flat_document(written, joints, time)
    )
    return encode_document(document, encoding)


def _with_idle_component(primitive: MotionPrimitive) -> MotionPrimitive:
    """Add a spatial component of zeros to a primitive that has no components."""
    spatial, shape = primitive.spatial, (1, *primitive.spatial.mean.shape)
    idle = replace(
        spatial, directions=np.zeros(shape), projections=np.zeros(shape), variances=np.ones(1), energy=np.ones(1)
    )
    return replace(primitive, spatial=idle, mixture=LatentMixture(np.ones(1), np.zeros((1, 1)), np.ones((1, 1, 1))))


def _layered_document(
    primitive: MotionPrimitive, animated_joints: tuple[str, ...], time: PredecessorTime | None
) -> dict[str, Any]:
    """Convert a primitive to layout 3, with the time function in the form `coefficients` (see `time_functions`)."""
    mean, vectors = _space(primitive, animated_joints)
    time = time or as_coefficients(primitive)
    frame_time_s = 1.0 / primitive.frame_rate_hz
    skeleton = {**skeleton_document(primitive.skeleton, form="file"), "frame_time": frame_time_s}
    return {
        "name": primitive.name,
        "sspm": {
            "eigen": vectors.reshape(len(vectors), mean.size).tolist(),
            "mean": mean.ravel().tolist(),
            "n_coeffs": len(mean),
            "n_dims": mean.shape[1],
            "knots": primitive.spatial.basis.knots.tolist(),
            "degree": primitive.spatial.basis.degree,
            "animated_joints": list(animated_joints),
        },
        "tspm": {
            "eigen": time.directions.tolist(),
            "mean": time.mean.tolist(),
            "n_coeffs": time.basis.count,
            "n_dims": 1,
            "knots": time.basis.knots.tolist(),
            "degree": time.basis.degree,
            "semantic_labels": {},
            "frame_time": frame_time_s,
        },
        "gmm": {**_mixture(primitive), "eigen": _roots(primitive.mixture.covariances).tolist()},
        "skeleton": skeleton,
        "keyframes": dict(primitive.keyframes),
    }


def _flat_document(
    primitive: MotionPrimitive, animated_joints: tuple[str, ...], time: PredecessorTime | None
) -> dict[str, Any]:
    """Convert a primitive to layout 2, with the time function `time` or, if it is None, one in the form `increments`.

    Readers recognise the form by the layout of the components: columns in the form `increments`, rows in the form
    `coefficients`.
    """
    mean, vectors = _space(primitive, animated_joints)
    time = time or as_increments(primitive)
    mixture = {f"gmm_{name}": values for name, values in _mixture(primitive).items()}
    return {
        "name": primitive.name,
        **mixture,
        "eigen_vectors_spatial": vectors.reshape(len(vectors), mean.size).tolist(),
        "mean_spatial_vector": mean.ravel().tolist(),
        "n_canonical_frames": primitive.frame_count,
        "translation_maxima": [1.0, 1.0, 1.0],
        "n_basis_spatial": len(mean),
        "n_dim_spatial": mean.shape[1],
        "b_spline_knots_spatial": primitive.spatial.basis.knots.tolist(),
        "eigen_vectors_time": (time.directions.T if time.form == "increments" else time.directions).tolist(),
        "mean_time_vector": time.mean.tolist(),
        "n_basis_time": time.basis.count,
        "b_spline_knots_time": time.basis.knots.tolist(),
        "animated_joints": list(animated_joints),
        "frame_time": 1.0 / primitive.frame_rate_hz,
        "skeleton": skeleton_document(primitive.skeleton, form="file"),
        "keyframes": dict(primitive.keyframes),
    }


def _space(primitive: MotionPrimitive, animated_joints: tuple[str, ...]) -> tuple[Floats, Floats]:
    """Compute spline coefficients of the animated joints: the mean (n, D), and k components (k, n, D).

    n is the number of coefficients of each of the D channels. The root's position is in centimetres, relative to its
    offset in the skeleton.
    """
    columns = columns_of(animated_joints, primitive.skeleton)
    mean = primitive.spatial.mean[:, columns].copy()
    vectors = primitive.spatial.directions[..., columns].copy()
    mean[:, :3] -= primitive.skeleton.offsets[0]
    mean[:, :3] /= CENTIMETRE_M
    vectors[..., :3] /= CENTIMETRE_M
    return mean, vectors


def _mixture(primitive: MotionPrimitive) -> dict[str, Any]:
    mixture = primitive.mixture
    return {
        "weights": mixture.weights.tolist(),
        "means": mixture.means.tolist(),
        "covars": mixture.covariances.tolist(),
    }


def _roots(covariances: Floats) -> Floats:
    """Factor covariances into E (K, L, L) with E · Eᵀ = covariance: eigenvectors times square roots of eigenvalues."""
    values, vectors = np.linalg.eigh(covariances)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])

"""Models in every file layout of Marey's predecessor, made of random numbers with a fixed seed."""

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.random import Generator

from marey_motion.formats.predecessor.skeleton import skeleton_document
from marey_motion.gait import generate_gait
from marey_motion.importing.files import import_file
from marey_motion.importing.items import FileToImport
from marey_motion.importing.plan import plan_imports
from marey_motion.modelling.splines import SplineBasis

FRAMES, SPATIAL, TEMPORAL = 48, 5, 3
COEFFICIENTS, TIME_COEFFICIENTS = 9, 8
SKELETON = generate_gait(1.0, 0.0, 1.0).skeleton
ANIMATED = SKELETON.joint_names[:12]
"""Joints that move; the other joints of the skeleton keep their rest pose."""


def knots(coefficients: int) -> list[float]:
    return SplineBasis.clamped(FRAMES, coefficients).knots.tolist()


def space(generator: Generator, joints: tuple[str, ...]) -> tuple[list[float], list[list[float]]]:
    """Return the mean and the components of a straight walk with small rotations of the joints, in centimetres."""
    channels = 3 + 4 * len(joints)
    mean = np.zeros((COEFFICIENTS, channels))
    mean[:, 2] = np.linspace(0.0, 130.0, COEFFICIENTS)
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (COEFFICIENTS, len(joints), 1))
    rotations += generator.normal(scale=0.1, size=rotations.shape)
    mean[:, 3:] = rotations.reshape(COEFFICIENTS, -1)
    vectors = np.linalg.qr(generator.normal(size=(mean.size, SPATIAL)))[0].T
    return mean.ravel().tolist(), vectors.tolist()


def time(generator: Generator) -> tuple[list[float], list[list[float]]]:
    """Return the mean and the components of the logarithms of time steps; each row is a component."""
    steps = np.diff(np.linspace(0.0, FRAMES - 1.0, TIME_COEFFICIENTS) + 1.0, prepend=0.0)
    mean = np.log(steps) + generator.normal(scale=0.05, size=TIME_COEFFICIENTS)
    mean[0] = 0.0
    vectors = np.linalg.qr(generator.normal(size=(TIME_COEFFICIENTS, TEMPORAL)))[0].T
    vectors[:, 0] = 0.0
    return mean.tolist(), (0.2 * vectors).tolist()


def mixture(
    generator: Generator, dimensions: int = SPATIAL + TEMPORAL
) -> tuple[list[float], list[list[float]], list[list[list[Any]]]]:
    shapes = generator.normal(size=(2, dimensions, dimensions))
    covariances = shapes @ shapes.transpose(0, 2, 1) / dimensions + 0.1 * np.eye(dimensions)
    return [0.4, 0.6], (0.3 * generator.normal(size=(2, dimensions))).tolist(), (0.1 * covariances).tolist()


def layout_3(seed: int = 1, joints: tuple[str, ...] = ANIMATED) -> dict[str, Any]:
    generator = np.random.default_rng(seed)
    mean, vectors = space(generator, joints)
    time_mean, time_vectors = time(generator)
    weights, means, covariances = mixture(generator)
    return {
        "name": "leftStance",
        "sspm": {
            "eigen": vectors, "mean": mean, "n_coeffs": COEFFICIENTS, "n_dims": 3 + 4 * len(joints),
            "knots": knots(COEFFICIENTS), "degree": 3, "animated_joints": list(joints),
        },
        "tspm": {
            "eigen": time_vectors, "mean": time_mean, "n_coeffs": TIME_COEFFICIENTS, "n_dims": 1,
            "knots": knots(TIME_COEFFICIENTS), "degree": 3, "semantic_labels": {}, "frame_time": 1.0 / 72.0,
        },
        "gmm": {"weights": weights, "means": means, "covars": covariances, "eigen": covariances},
        "skeleton": skeleton_document(SKELETON, form="file"),
        "keyframes": {"contact0": 20},
    }  # fmt: skip


def flat(seed: int = 1, joints: tuple[str, ...] = ANIMATED) -> dict[str, Any]:
    """Return the members that layouts 1 and 2 share."""
    generator = np.random.default_rng(seed)
    mean, vectors = space(generator, joints)
    weights, means, covariances = mixture(generator)
    return {
        "name": "walk_leftStance", "gmm_weights": weights, "gmm_means": means, "gmm_covars": covariances,
        "eigen_vectors_spatial": vectors, "mean_spatial_vector": mean, "n_canonical_frames": FRAMES,
        "translation_maxima": [1.0, 2.0, 4.0], "n_basis_spatial": COEFFICIENTS, "n_dim_spatial": 3 + 4 * len(joints),
        "b_spline_knots_spatial": knots(COEFFICIENTS), "animated_joints": list(joints),
        "skeleton": skeleton_document(SKELETON, form="file"), "frame_time": 1.0 / 60.0,
    }  # fmt: skip


def layout_2(seed: int = 1, joints: tuple[str, ...] = ANIMATED, *, by_columns: bool = True) -> dict[str, Any]:
    """Return a document of layout 2. With `by_columns`, components of time are columns, as in the oldest files."""
    mean, vectors = time(np.random.default_rng(seed + 100))
    if by_columns:
        mean = (0.02 * np.random.default_rng(seed).normal(size=TIME_COEFFICIENTS)).tolist()
        vectors = np.transpose(vectors).tolist()
    return flat(seed, joints) | {
        "eigen_vectors_time": vectors, "mean_time_vector": mean, "n_basis_time": TIME_COEFFICIENTS,
        "b_spline_knots_time": knots(TIME_COEFFICIENTS),
    }  # fmt: skip


def layout_1(seed: int = 1, joints: tuple[str, ...] = ANIMATED) -> dict[str, Any]:
    mean, vectors = time(np.random.default_rng(seed + 100))
    return flat(seed, joints) | {
        "npc_spatial": SPATIAL, "eigen_vectors_temporal_semantic": vectors, "mean_temporal_semantic_vector": mean,
        "n_basis_temporal_semantic": TIME_COEFFICIENTS, "n_dim_temporal_semantic": 1,
        "b_spline_knots_temporal_semantic": knots(TIME_COEFFICIENTS), "npc_temporal_semantic": TEMPORAL,
        "semantic_annotation": {},
    }  # fmt: skip


def static(seed: int = 1, joints: tuple[str, ...] = SKELETON.joint_names) -> dict[str, Any]:
    mean, _ = space(np.random.default_rng(seed), joints)
    return {
        "name": "idle", "spatial_coeffs": np.reshape(mean, (COEFFICIENTS, -1)).tolist(), "knots": knots(COEFFICIENTS),
        "n_canonical_frames": FRAMES, "skeleton": skeleton_document(SKELETON, form="file"),
    }  # fmt: skip


LAYOUTS: dict[str, Callable[[], dict[str, Any]]] = {
    "3": layout_3,
    "2": layout_2,
    "2 later": lambda: layout_2(by_columns=False),
    "1": layout_1,
    "static": static,
}


def tree(generator: Any = None) -> dict[str, Any]:
    """Return a cluster tree of 40 samples; each inner node has up to four children, and each leaf has one sample."""
    generator = generator or np.random.default_rng(7)
    data = generator.normal(size=(40, SPATIAL + TEMPORAL))

    def node(indices: list[int], level: int) -> dict[str, Any]:
        parts = [indices[i::4] for i in range(4)] if len(indices) > 1 else []
        children = [node(part, level + 1) for part in parts if part]
        return {"mean": data[indices].mean(axis=0).tolist(), "indices": indices, "children": children}

    return {
        "data": data.tolist(),
        "features": data[:, :SPATIAL].tolist(),
        "options": {"n_subdivisions": 4, "clustering_method": 0, "use_feature_mean": False},
        "root": node(list(range(40)), 0),
    }


FILE, TREE_FILE = f"sha256:{'1' * 64}", f"sha256:{'2' * 64}"


def imported() -> tuple[Mapping[str, Any], dict[str, Any]]:
    """Import a model with its tree from two files; return the parts of the model and the hierarchy of its skeleton."""
    planned, companion = plan_imports(["in/walk_mm.json", "in/walk_cluster_tree.json"])
    assert (planned.companion, companion.role) == ("in/walk_cluster_tree.json", "companion")
    data, beside = (json.dumps(one).encode() for one in (layout_3(), tree()))
    found = import_file(FileToImport(planned, data, FILE, companion=beside, companion_digest=TREE_FILE))
    skeleton, model = found.items
    assert model.parts["model"]["skeleton"] == {"output": skeleton.name}
    model.parts["model"]["skeleton"] = {"output": "skeleton"}
    return model.parts, skeleton.parts["hierarchy"]

"""The predecessor's motion primitives, in the four layouts that were published.

Layout 3 has the parts `sspm` (space), `tspm` (time) and `gmm`; layouts 1 and 2 are flat, with fields
`eigen_vectors_spatial` for space and `*_temporal_semantic*` or `*_time*` for time; a static primitive has
`spatial_coeffs` alone. Right-handed, centimetres, quaternions w, x, y, z; the root's translation is added to the root's
offset. Arrays of coefficients have the shape (coefficient, channel).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import FormatError, FormatLimit, MotionError
from marey_motion.formats.conversion import convert
from marey_motion.formats.document_fields import field_of, number_array, text_list
from marey_motion.formats.predecessor.encoding import decode_document
from marey_motion.formats.predecessor.skeleton import CENTIMETRE_M, read_skeleton_document
from marey_motion.formats.predecessor.time_functions import (
    DRAWN,
    SEED,
    PredecessorTime,
    TimeForm,
    as_log_slopes,
    components_of,
)
from marey_motion.modelling.mixture import LatentMixture
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.splines import DEGREE, SplineBasis
from marey_motion.skeleton import Skeleton
from marey_schemas.options.imports import ImportOptions

Layout = Literal["1", "2", "3", "static"]
Document = Mapping[str, Any]

DEFAULT_FRAME_TIME_S = 1.0 / 30.0
MOST_COMPONENTS, MOST_DIMENSIONS, MOST_FRAMES = 100, 2000, 20_000
MOST_VALUES = 10_000_000
LARGEST = 1e12
WEIGHTS_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class PredecessorModel:
    """A model read from a document of the predecessor.

    Parameters
    ----------
    primitive : the model in Marey's units and conventions
    layout : layout of the document
    animated_joints : joints whose rotations are in the document; all other joints keep their rest rotation
    time_form : form of the document's time function; None if it has none, so that the model runs at constant speed
    time_error_frames : largest difference between the time functions of `primitive` and of the document, in frames
    """

    primitive: MotionPrimitive
    layout: Layout
    animated_joints: tuple[str, ...]
    time_form: TimeForm | None
    time_error_frames: float


def layout_of(document: Document) -> Layout | None:
    """Detect the layout of a document.

    Parameters
    ----------
    document : mapping    the document

    Returns
    -------
    str or None    "1", "2", "3" or "static"; None if it is not a model
    """
    if isinstance(document.get("sspm"), dict) and "gmm" in document:
        return "3"
    if "eigen_vectors_spatial" in document:
        return "1" if "mean_temporal_semantic_vector" in document else "2"
    return "static" if "spatial_coeffs" in document else None


def read_predecessor_model(data: bytes, file: str, *, skeleton: Skeleton | None = None) -> PredecessorModel:
    """Read a model of any layout, as JSON, BSON or compressed BSON.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    its name, for messages
    skeleton : Skeleton, optional    skeleton of the model, needed if the document contains none

    Returns
    -------
    PredecessorModel    the model in metres

    Raises
    ------
    FormatError    naming the invalid field
    """
    return model_of_document(decode_document(data, file), file, skeleton=skeleton)


def model_of_document(document: Document, file: str, *, skeleton: Skeleton | None = None) -> PredecessorModel:
    """Read a model from a decoded document, as `read_predecessor_model` does.

    Parameters
    ----------
    document : mapping    the document
    file : str    name of the file, for messages
    skeleton : Skeleton, optional    skeleton of the model, needed if the document contains none

    Returns
    -------
    PredecessorModel    the model in metres

    Raises
    ------
    FormatError    naming the invalid field
    """
    layout = layout_of(document)
    if layout is None:
        message = "the document is not a model: it has neither 'sspm', 'eigen_vectors_spatial' nor 'spatial_coeffs'"
        raise FormatError(message, code="document-unknown", file=file)
    own = _skeleton(document, file) or skeleton
    if own is None:
        message = "the file does not contain the skeleton of the model; choose a skeleton of the project"
        raise FormatError(message, code="skeleton-missing", file=file)
    try:
        return _read(_as_parts(document, layout, file), layout, own, file)
    except FormatError:
        raise
    except MotionError as error:
        raise FormatError(
            f"the numbers in the file are not a valid model: {error}", code="model-invalid", file=file
        ) from error


@dataclass(frozen=True, eq=False)
class _Parts:
    """Contents of a model document, with the same names for all layouts."""

    name: str
    space: Document
    translation_maxima: Floats
    time: Document | None
    time_form: TimeForm
    mixture: Document | None
    animated_joints: list[str] | None
    frame_time_s: float
    keyframes: Mapping[str, int]


def _as_parts(document: Document, layout: Layout, file: str) -> _Parts:
    if layout == "3":
        space = field_of(document, "sspm", dict, file)
        time: Document | None = field_of(document, "tspm", dict, file) if document.get("tspm") else None
        mixture: Document | None = field_of(document, "gmm", dict, file)
    elif layout == "static":
        space = {
            "mean": field_of(document, "spatial_coeffs", list, file),
            "knots": field_of(document, "knots", list, file),
        }
        time, mixture = None, None
    else:
        space = _renamed(document, _FLAT_SPACE)
        time = _renamed(document, _FLAT_TIME if layout == "2" else _FLAT_TIME_SEMANTIC)
        mixture = _renamed(document, _FLAT_MIXTURE)
    time, form = _time_part(time, layout, file)
    skeleton = document.get("skeleton")
    rate_sources = (time or {}, document, skeleton if isinstance(skeleton, dict) else {})
    frame_time_s = next((one["frame_time"] for one in rate_sources if one.get("frame_time")), DEFAULT_FRAME_TIME_S)
    if not isinstance(frame_time_s, int | float) or not 1e-5 < frame_time_s < 10.0:
        message = f"field 'frame_time' must be a number of seconds above 1e-5 and below 10, not {frame_time_s!r}"
        raise FormatError(message, code="bad-number", file=file)
    joints = next((one for one in (space, document) if "animated_joints" in one), None)
    if joints is None and isinstance(skeleton, dict) and isinstance(skeleton.get("animated_joints"), list):
        joints = skeleton
    maxima = _numbers(
        document.get("translation_maxima", space.get("translation_maxima", [1, 1, 1])), file, "translation_maxima"
    )
    if maxima.shape != (3,):
        raise FormatError("field 'translation_maxima' must be three numbers", code="bad-number", file=file)
    return _Parts(
        name=str(document.get("name") or ""),
        space=space,
        translation_maxima=maxima,
        time=time,
        time_form=form,
        mixture=mixture,
        animated_joints=None if joints is None else text_list(joints, "animated_joints", file),
        frame_time_s=float(frame_time_s),
        keyframes=_keyframes(document, file),
    )


_FLAT_SPACE = {
    "eigen": "eigen_vectors_spatial",
    "mean": "mean_spatial_vector",
    "n_coeffs": "n_basis_spatial",
    "n_dims": "n_dim_spatial",
    "knots": "b_spline_knots_spatial",
    "n_frames": "n_canonical_frames",
}
_FLAT_TIME = {
    "eigen": "eigen_vectors_time",
    "mean": "mean_time_vector",
    "n_coeffs": "n_basis_time",
    "n_dims": "n_dim_time",
    "knots": "b_spline_knots_time",
    "n_frames": "n_canonical_frames",
}
_FLAT_TIME_SEMANTIC = {
    "eigen": "eigen_vectors_temporal_semantic",
    "mean": "mean_temporal_semantic_vector",
    "n_coeffs": "n_basis_temporal_semantic",
    "n_dims": "n_dim_temporal_semantic",
    "knots": "b_spline_knots_temporal_semantic",
    "n_frames": "n_canonical_frames",
}
_FLAT_MIXTURE = {"weights": "gmm_weights", "means": "gmm_means", "covars": "gmm_covars"}


def _renamed(document: Document, names: Mapping[str, str]) -> dict[str, Any]:
    return {ours: document[theirs] for ours, theirs in names.items() if theirs in document}


def _time_part(time: Document | None, layout: Layout, file: str) -> tuple[Document | None, TimeForm]:
    """Return the time part of a model, with one component per row, and its form; None if the model has no time part.

    Layout 2 was written by two training programs. The first stores components as columns and uses the form
    `increments`; the later one stores them as rows and uses the form `coefficients`, as layout 3 does.
    """
    if time is None or not time.get("mean"):
        return None, "coefficients"
    count = len(field_of(time, "mean", list, file))
    if layout != "2":
        return time, "coefficients"
    vectors = _numbers(time.get("eigen", []), file, _FLAT_TIME["eigen"])
    if vectors.ndim == 2 and vectors.shape[1] != count and vectors.shape[0] == count:
        return {**time, "eigen": vectors.T.tolist()}, "increments"
    return time, "coefficients"


def _keyframes(document: Document, file: str) -> dict[str, int]:
    if "keyframes" not in document:
        return {}
    given = field_of(document, "keyframes", dict, file)
    for label, frame in given.items():
        if not isinstance(frame, int) or isinstance(frame, bool) or frame < 0:
            raise FormatError(f"field 'keyframes': {label!r} must be the number of a frame, not {frame!r}", file=file)
    return dict(given)


def _skeleton(document: Document, file: str) -> Skeleton | None:
    if not isinstance(document.get("skeleton"), dict):
        return None
    return convert(read_skeleton_document(document["skeleton"], file), file, ImportOptions()).skeleton


def _read(parts: _Parts, layout: Layout, skeleton: Skeleton, file: str) -> PredecessorModel:
    basis, mean, vectors = _functions(parts.space, "space", file)
    animated = _animated(parts, basis, mean, skeleton, file)
    spatial_mean, spatial_vectors = _on_skeleton(mean, vectors, parts.translation_maxima, animated, skeleton)
    frames = basis.frame_count
    time = _constant_speed(frames) if parts.time is None else _time(parts, frames, file)
    mixture, temporal_count = _mixture(parts.mixture, len(spatial_vectors), len(time.directions), file)
    time = PredecessorTime(time.form, time.basis, time.mean, time.directions[:temporal_count])
    latents = mixture.sample(DRAWN, SEED)
    spread = _variances(mixture)
    temporal, error = as_log_slopes(time, latents[:, len(spatial_vectors) :], spread[len(spatial_vectors) :], file)
    spatial = components_of(basis, spatial_mean, spatial_vectors, spread[: len(spatial_vectors)])
    if odd := [label for label, frame in parts.keyframes.items() if frame >= frames]:
        raise FormatError(
            f"field 'keyframes': frame {odd[0]!r} is outside the {frames} canonical frames of the model", file=file
        )
    primitive = MotionPrimitive(
        parts.name, skeleton, 1.0 / parts.frame_time_s, spatial, temporal, 1.0, mixture, parts.keyframes
    )
    return PredecessorModel(primitive, layout, tuple(animated), time.form if parts.time else None, error)


def _constant_speed(frames: int) -> PredecessorTime:
    """Make a time function of constant speed, which maps each canonical frame to the frame with the same number."""
    basis = SplineBasis.clamped(frames, DEGREE + 1)
    return PredecessorTime("increments", basis, np.zeros(basis.count), np.zeros((0, basis.count)))


def _functions(part: Document, what: str, file: str) -> tuple[SplineBasis, Floats, Floats]:
    """Read basis, mean (n, D) and components (k, n, D) of the spatial or temporal functions."""
    basis = _basis(part, what, file)
    start, stop = basis.span
    if start != 0.0 or abs(stop - round(stop)) > 1e-6 or stop < 2.0:
        raise FormatError(
            f"{what}: the knots of the spline go from {start:g} to {stop:g}, but must go from 0 "
            "to the number of the last frame",
            file=file,
        )
    mean = _numbers(field_of(part, "mean", list, file), file, f"{what}: mean")
    if mean.size % basis.count or mean.size == 0:
        raise FormatError(
            f"{what}: the mean has {mean.size} numbers, which is not a multiple of the "
            f"{basis.count} spline coefficients",
            file=file,
        )
    if part.get("n_coeffs", basis.count) != basis.count:
        message = f"{what}: n_coeffs is {part['n_coeffs']}, but the knots fit {basis.count} coefficients"
        raise FormatError(message, file=file)
    channels = mean.size // basis.count
    if part.get("n_dims", channels) != channels:
        raise FormatError(
            f"{what}: the field n_dims is {part['n_dims']}, but the mean has {channels} channels", file=file
        )
    given = part.get("eigen") or []
    vectors = _numbers(given, file, f"{what}: eigen") if given else np.zeros((0, mean.size))
    if vectors.ndim == 2 and vectors.shape[1] != mean.size and vectors.shape[0] == mean.size:
        vectors = vectors.T
    if vectors.ndim != 2 or vectors.shape[1] != mean.size:
        raise FormatError(
            f"{what}: the eigenvectors have the shape {vectors.shape}, which does not fit a mean "
            f"of {mean.size} numbers",
            file=file,
        )
    shape = (basis.count, channels)
    return basis, mean.reshape(shape), np.ascontiguousarray(vectors).reshape(len(vectors), *shape)


def _basis(part: Document, what: str, file: str) -> SplineBasis:
    """Make the basis over the knots; the oldest models have the numbers of coefficients and frames instead of knots."""
    if "knots" not in part and "n_frames" in part:
        frames, count = (field_of(part, name, int, file) for name in ("n_frames", "n_coeffs"))
        if not 2 <= count <= frames <= MOST_FRAMES:
            raise FormatError(
                f"{what}: {count} spline coefficients are not possible for {frames} frames",
                code="model-invalid",
                file=file,
            )
        _check_size(frames, count, what, file)
        return SplineBasis.clamped(frames, count)
    knots = _numbers(field_of(part, "knots", list, file), file, f"{what}: knots")
    if knots.ndim != 1 or not 0 < len(knots) <= MOST_FRAMES or np.abs(knots).max() > MOST_FRAMES:
        raise FormatError(
            f"{what}: there may be at most {MOST_FRAMES} knots, and no knot may be above {MOST_FRAMES}", file=file
        )
    degree = part.get("degree", DEGREE)
    if isinstance(degree, bool) or not isinstance(degree, int) or not 1 <= degree < 10:
        raise FormatError(
            f"{what}: the degree of the spline is {degree!r}, but must be a small whole number", file=file
        )
    basis = SplineBasis(knots, degree)
    _check_size(basis.frame_count, basis.count, what, file)
    return basis


def _check_size(frames: int, coefficients: int, what: str, file: str) -> None:
    """Refuse splines whose evaluation would need too much memory, even if the document is small."""
    if frames * coefficients > MOST_VALUES:
        message = (
            f"{what}: {coefficients} coefficients over {frames} frames; the limit of the product is {MOST_VALUES:,}"
        )
        raise FormatLimit(message, file=file)


def _animated(parts: _Parts, basis: SplineBasis, mean: Floats, skeleton: Skeleton, file: str) -> list[str]:
    """List the joints that the model rotates. Raises `FormatError` if the skeleton lacks them."""
    animated = parts.animated_joints or list(skeleton.joint_names)
    if mean.shape[1] != 3 + 4 * len(animated):
        message = f"the mean has {mean.shape[1]} channels, but {len(animated)} joints need {3 + 4 * len(animated)}"
        raise FormatError(message, code="joints-mismatch", file=file)
    if len(set(animated)) != len(animated):
        raise FormatError("field 'animated_joints' names a joint twice", file=file)
    unknown = next((name for name in animated if name not in skeleton), None)
    if unknown is not None:
        raise FormatError("the skeleton has no joint of this name", code="joints-mismatch", file=file, joint=unknown)
    if (np.linalg.norm(basis.at_frames @ mean[:, 3:], axis=1) == 0).any():
        raise FormatError("the mean motion has frames whose rotations are all zero", code="model-invalid", file=file)
    return animated


def _on_skeleton(
    mean: Floats, vectors: Floats, maxima: Floats, animated: list[str], skeleton: Skeleton
) -> tuple[Floats, Floats]:
    """Extend mean (n, 3 + 4·J) and components (k, n, 3 + 4·J) to all joints, in metres; others keep rest rotations."""
    rest = np.concatenate((np.zeros(3), skeleton.rest_rotations.ravel()))
    columns = columns_of(animated, skeleton)
    whole = np.tile(rest, (len(mean), 1))
    whole[:, columns] = mean
    directions = np.zeros((len(vectors), *whole.shape))
    directions[..., columns] = vectors
    for values in (whole, directions):
        values[..., :3] *= maxima * CENTIMETRE_M
    whole[:, :3] += skeleton.offsets[0]  # B-splines add up to 1
    return whole, directions


def columns_of(animated: list[str] | tuple[str, ...], skeleton: Skeleton) -> NDArray[np.int64]:
    """Select the channels of a pose for the root's translation and some joints' rotations, in order.

    Parameters
    ----------
    animated : sequence of str    names of k joints
    skeleton : Skeleton    J joints

    Returns
    -------
    (3 + 4·k,) int64    columns of a pose (3 + 4·J)
    """
    joints = np.array([skeleton.index_of(name) for name in animated], dtype=np.int64)
    return np.concatenate((np.arange(3), (3 + 4 * joints[:, None] + np.arange(4)).ravel()))


def _time(parts: _Parts, frames: int, file: str) -> PredecessorTime:
    """Read the time function from the first channel; further channels contain semantic annotations and are ignored."""
    assert parts.time is not None
    basis, mean, vectors = _functions(parts.time, "time", file)
    if basis.frame_count != frames:
        message = f"the time part spans {basis.frame_count} canonical frames, but the space part {frames}"
        raise FormatError(message, code="model-invalid", file=file)
    return PredecessorTime(parts.time_form, basis, mean[:, 0], vectors[..., 0])


def _mixture(part: Document | None, spatial: int, temporal: int, file: str) -> tuple[LatentMixture, int]:
    """Read the mixture and its number of temporal components, which is 0 for mixtures of space alone."""
    if part is None:
        dimensions = spatial + temporal
        return LatentMixture(np.ones(1), np.zeros((1, dimensions)), np.eye(dimensions)[None]), temporal
    weights, means, covariances = (
        _numbers(field_of(part, name, list, file), file, f"gmm: {name}") for name in ("weights", "means", "covars")
    )
    if means.ndim == 2 and not means.size and not covariances.size:
        covariances = np.zeros((len(means), 0, 0))  # lists of nothing do not tell how many there are
    if means.ndim != 2 or covariances.shape != (len(means), *[means.shape[1]] * 2) or weights.shape != (len(means),):
        shapes = f"{weights.shape}, {means.shape} and {covariances.shape}"
        raise FormatError(
            f"gmm: the shapes of weights, means and covars, {shapes}, do not fit each other",
            code="model-invalid",
            file=file,
        )
    if len(means) > MOST_COMPONENTS or means.shape[1] > MOST_DIMENSIONS:
        raise FormatError(
            f"gmm: the mixture has more than {MOST_COMPONENTS} distributions or more than {MOST_DIMENSIONS} dimensions",
            file=file,
        )
    covered = means.shape[1] - spatial
    if not 0 <= covered <= temporal:
        parts = f"space has {spatial} components and time {temporal}"
        message = f"gmm: the means have {means.shape[1]} dimensions, but {parts}"
        raise FormatError(message, code="model-invalid", file=file)
    if (weights <= 0).any() or abs(float(weights.sum()) - 1.0) > WEIGHTS_TOLERANCE:
        raise FormatError("gmm: the weights must be positive and add up to 1", code="model-invalid", file=file)
    symmetric = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    mixture = LatentMixture(weights / weights.sum(), means, symmetric)
    if means.shape[1]:
        _ = mixture.cholesky  # refuses what is no covariance
    return mixture, covered


def _numbers(values: Any, file: str, name: str) -> Floats:
    """Convert nested lists to an array. Raises `FormatError` if a number is too large for the motion of a body."""
    numbers = number_array(values, file, name)
    if np.abs(numbers).max(initial=0.0) > LARGEST:
        raise FormatError(
            f"field {name!r} contains numbers that are larger than {LARGEST:g}", code="bad-number", file=file
        )
    return numbers


def _variances(mixture: LatentMixture) -> Floats:
    """Compute the variance (L,) of each number of the latent vectors."""
    mean = mixture.weights @ mixture.means
    squares = np.diagonal(mixture.covariances, axis1=1, axis2=2) + mixture.means**2
    return np.asarray(np.maximum(mixture.weights @ squares - mean**2, 0.0))

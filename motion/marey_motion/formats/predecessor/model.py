"""Motion primitives of Marey's predecessor, in the four layouts that were published (see `model_layouts`).

The documents are right-handed, with lengths in centimetres and quaternions w, x, y, z. The root's translation is added
to the root's offset. Arrays of coefficients have the shape (coefficient, channel).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import FormatError, FormatLimit, MotionError
from marey_motion.formats.conversion import convert
from marey_motion.formats.document_fields import field_of
from marey_motion.formats.predecessor.encoding import decode_document
from marey_motion.formats.predecessor.model_layouts import (
    Document,
    Layout,
    ModelParts,
    layout_of,
    model_numbers,
    parts_of_model,
)
from marey_motion.formats.predecessor.skeleton import CENTIMETRE_M, read_skeleton_document
from marey_motion.formats.predecessor.time_functions import (
    DRAWN,
    SEED,
    PredecessorTime,
    as_log_slopes,
    components_of,
)
from marey_motion.modelling.mixture import LatentMixture
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.splines import DEGREE, SplineBasis
from marey_motion.skeleton import Skeleton
from marey_schemas.options.imports import ImportOptions

MOST_COMPONENTS, MOST_DIMENSIONS, MOST_FRAMES = 100, 2000, 20_000
MOST_VALUES = 10_000_000
WEIGHTS_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class PredecessorModel:
    """A model read from a document of the predecessor.

    Parameters
    ----------
    primitive : the model in Marey's units and conventions
    layout : layout of the document: "1", "2", "3" or "static"
    animated_joints : joints whose rotations are in the document; all other joints keep their rest rotation
    time : time function (time warp) of the document, limited to the components whose scores the mixture contains; None
        if the document has no time function, so that the model runs at constant speed
    time_error_frames : largest difference between the time functions of `primitive` and of the document, in frames
    moved_keyframes : labels of keyframes that the document places after the last frame; in `primitive`, they are at
        the last frame
    """

    primitive: MotionPrimitive
    layout: Layout
    animated_joints: tuple[str, ...]
    time: PredecessorTime | None
    time_error_frames: float
    moved_keyframes: tuple[str, ...] = ()


def read_predecessor_model(data: bytes, file: str, *, skeleton: Skeleton | None = None) -> PredecessorModel:
    """Read a model of any layout, as JSON, BSON or compressed BSON.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages
    skeleton : Skeleton, optional    skeleton of the model, needed if the document contains none

    Returns
    -------
    PredecessorModel    the model in metres

    Raises
    ------
    FormatError    if a field is invalid (the error names it), or if the document has no skeleton and `skeleton` is None
    """
    return model_of_document(decode_document(data, file), file, skeleton=skeleton)


def model_of_document(document: Document, file: str, *, skeleton: Skeleton | None = None) -> PredecessorModel:
    """Read a model of any layout from a decoded document of Marey's predecessor.

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
    FormatError    if a field is invalid (the error names it), or if the document has no skeleton and `skeleton` is None
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
        return _read(parts_of_model(document, layout, file), layout, own, file)
    except FormatError:
        raise
    except MotionError as error:
        raise FormatError(
            f"the numbers in the file are not a valid model: {error}", code="model-invalid", file=file
        ) from error


def _skeleton(document: Document, file: str) -> Skeleton | None:
    if not isinstance(document.get("skeleton"), dict):
        return None
    return convert(read_skeleton_document(document["skeleton"], file), file, ImportOptions()).skeleton


def _read(parts: ModelParts, layout: Layout, skeleton: Skeleton, file: str) -> PredecessorModel:
    basis, mean, vectors = _functions(parts.space, "space", file)
    animated = _animated(parts, basis, mean, skeleton, file)
    if (size := len(vectors) * basis.count * (3 + 4 * skeleton.joint_count)) > MOST_VALUES:
        message = (
            f"space: {len(vectors)} components of {basis.count} coefficients for {skeleton.joint_count} joints have "
            f"{size:,} numbers; the limit is {MOST_VALUES:,}"
        )
        raise FormatLimit(message, file=file)
    spatial_mean, spatial_vectors = _on_skeleton(mean, vectors, parts.translation_maxima, animated, skeleton)
    frames = basis.frame_count
    time = _constant_speed(frames) if parts.time is None else _time(parts, frames, file)
    mixture, temporal_count = _mixture(parts.mixture, len(spatial_vectors), len(time.directions), file)
    time = PredecessorTime(time.form, time.basis, time.mean, time.directions[:temporal_count])
    latents = mixture.sample(DRAWN, SEED)
    spread = _variances(mixture)
    temporal, error = as_log_slopes(time, latents[:, len(spatial_vectors) :], spread[len(spatial_vectors) :], file)
    spatial = components_of(basis, spatial_mean, spatial_vectors, spread[: len(spatial_vectors)])
    # A keyframe at the end of the last section has the number of frames, a greater number, or -1.
    keyframes = {label: frame if 0 <= frame < frames else frames - 1 for label, frame in parts.keyframes.items()}
    moved = tuple(label for label, frame in parts.keyframes.items() if keyframes[label] != frame)
    primitive = MotionPrimitive(
        parts.name, skeleton, 1.0 / parts.frame_time_s, spatial, temporal, 1.0, mixture, keyframes
    )
    return PredecessorModel(primitive, layout, tuple(animated), time if parts.time else None, error, moved)


def _constant_speed(frames: int) -> PredecessorTime:
    """Make a time function of constant speed, which maps each canonical frame to the frame with the same number."""
    basis = SplineBasis.clamped(frames, DEGREE + 1)
    return PredecessorTime("increments", basis, np.zeros(basis.count), np.zeros((0, basis.count)))


def _functions(part: Document, what: str, file: str) -> tuple[SplineBasis, Floats, Floats]:
    """Read the spatial or temporal functions, as n spline coefficients for each of D channels.

    `what` is the name of the part, for messages. Returns the spline basis, the mean (n, D) and the components (k, n,
    D).
    """
    basis = _basis(part, what, file)
    start, stop = basis.span
    if start != 0.0 or abs(stop - round(stop)) > 1e-6 or stop < 2.0:
        raise FormatError(
            f"{what}: the knots of the spline go from {start:g} to {stop:g}, but must go from 0 "
            "to the number of the last frame",
            file=file,
        )
    mean = model_numbers(field_of(part, "mean", list, file), file, f"{what}: mean")
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
            f"{what}: the field `n_dims` is {part['n_dims']}, but the mean has {channels} channels", file=file
        )
    given = part.get("eigen") or []
    vectors = model_numbers(given, file, f"{what}: eigen") if given else np.zeros((0, mean.size))
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
    """Make the splines of a part from its knots.

    The oldest models contain the number of coefficients and the number of frames instead of knots.
    """
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
    knots = model_numbers(field_of(part, "knots", list, file), file, f"{what}: knots")
    if knots.ndim != 1 or not 0 < len(knots) <= MOST_FRAMES or np.abs(knots).max() > MOST_FRAMES:
        raise FormatError(
            f"{what}: the knots must be a list of 1 to {MOST_FRAMES} numbers from -{MOST_FRAMES} to {MOST_FRAMES}",
            file=file,
        )
    degree = part.get("degree", DEGREE)
    if isinstance(degree, bool) or not isinstance(degree, int) or not 1 <= degree < 10:
        raise FormatError(
            f"{what}: the degree of the spline is {degree!r}, but must be a whole number from 1 to 9", file=file
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


def _animated(parts: ModelParts, basis: SplineBasis, mean: Floats, skeleton: Skeleton, file: str) -> list[str]:
    """List the joints that the model rotates.

    `mean` (n, D) contains the coefficients of the model's mean motion. Raises `FormatError` if D does not fit the
    number of joints, if a joint is listed twice or missing from the skeleton, or if all rotations of a frame are zero.
    """
    animated = parts.animated_joints or list(skeleton.joint_names)
    if mean.shape[1] != 3 + 4 * len(animated):
        message = f"the mean has {mean.shape[1]} channels, but {len(animated)} joints need {3 + 4 * len(animated)}"
        raise FormatError(message, code="joints-mismatch", file=file)
    repeated = next((name for name, count in Counter(animated).items() if count > 1), None)
    if repeated is not None:
        raise FormatError(
            "field 'animated_joints' contains this joint twice; remove one entry", file=file, joint=repeated
        )
    unknown = next((name for name in animated if name not in skeleton), None)
    if unknown is not None:
        raise FormatError(
            "the skeleton has no joint of this name; use the skeleton of this model",
            code="joints-mismatch",
            file=file,
            joint=unknown,
        )
    if (np.linalg.norm(basis.at_frames @ mean[:, 3:], axis=1) == 0).any():
        raise FormatError("the mean motion has frames whose rotations are all zero", code="model-invalid", file=file)
    return animated


def _on_skeleton(
    mean: Floats, vectors: Floats, maxima: Floats, animated: list[str], skeleton: Skeleton
) -> tuple[Floats, Floats]:
    """Extend the functions of the `animated` joints to all J joints of the skeleton, and convert them to metres.

    `maxima` (3,) are factors of the root's translation. Joints that are not in `animated` keep their rest rotations.
    Returns the mean (n, 3 + 4·J) and the components (k, n, 3 + 4·J).
    """
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
    """List the columns of a pose that contain the root's translation and the rotations of some joints, in order.

    Parameters
    ----------
    animated : sequence of str    names of k joints
    skeleton : Skeleton    J joints

    Returns
    -------
    (3 + 4·k,) int64    indices into a pose of 3 + 4·J numbers
    """
    joints = np.array([skeleton.index_of(name) for name in animated], dtype=np.int64)
    return np.concatenate((np.arange(3), (3 + 4 * joints[:, None] + np.arange(4)).ravel()))


def _time(parts: ModelParts, frames: int, file: str) -> PredecessorTime:
    """Read the time function, which is the first channel of the time part.

    The other channels are semantic annotations and are ignored.
    """
    assert parts.time is not None
    basis, mean, vectors = _functions(parts.time, "time", file)
    if basis.frame_count != frames:
        message = f"the time part spans {basis.frame_count} canonical frames, but the space part {frames}"
        raise FormatError(message, code="model-invalid", file=file)
    return PredecessorTime(parts.time_form, basis, mean[:, 0], vectors[..., 0])


def _mixture(part: Document | None, spatial: int, temporal: int, file: str) -> tuple[LatentMixture, int]:
    """Read the Gaussian mixture of the latent vectors, and the number of temporal scores in each of these vectors.

    The number is 0 if the vectors contain spatial scores only. `spatial` and `temporal` are the numbers of spatial and
    temporal components of the model.
    """
    if part is None:
        dimensions = spatial + temporal
        return LatentMixture(np.ones(1), np.zeros((1, dimensions)), np.eye(dimensions)[None]), temporal
    weights, means, covariances = (
        model_numbers(field_of(part, name, list, file), file, f"gmm: {name}") for name in ("weights", "means", "covars")
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
            f"gmm: the mixture has {len(means)} distributions of {means.shape[1]} dimensions; at most "
            f"{MOST_COMPONENTS} distributions of {MOST_DIMENSIONS} dimensions can be imported",
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


def _variances(mixture: LatentMixture) -> Floats:
    """Compute the variance (L,) of each number of the latent vectors."""
    mean = mixture.weights @ mixture.means
    squares = np.diagonal(mixture.covariances, axis1=1, axis2=2) + mixture.means**2
    return np.asarray(np.maximum(mixture.weights @ squares - mean**2, 0.0))

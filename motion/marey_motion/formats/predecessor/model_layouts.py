"""Conversion of the four layouts of motion primitives of Marey's predecessor to one form.

A model consists of a spatial part (the poses over canonical time), a temporal part (the time function, which warps
time) and a Gaussian mixture of latent vectors. Layouts 1 and 2 are flat: fields such as `eigen_vectors_spatial` contain
the spatial part, and fields `*_temporal_semantic*` (layout 1) or `*_time*` (layout 2) contain the temporal part. Layout
3 has one object for each part: `sspm` (spatial), `tspm` (temporal) and `gmm` (mixture). The layout `static` has only a
mean motion, in the field `spatial_coeffs`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import FormatError
from marey_motion.formats.document_fields import field_of, number_array, text_list
from marey_motion.formats.predecessor.sections import LAST_FRAME
from marey_motion.formats.predecessor.time_functions import TimeForm

Layout = Literal["1", "2", "3", "static"]
Document = Mapping[str, Any]

DEFAULT_FRAME_TIME_S = 1.0 / 30.0
MOST_NUMBER = 1e12
"""Greatest absolute value that a number in a model may have."""


def layout_of(document: Document) -> Layout | None:
    """Detect the layout of a document.

    Parameters
    ----------
    document : mapping    the document

    Returns
    -------
    str or None    "1", "2", "3" or "static"; None if the document is not a model
    """
    if isinstance(document.get("sspm"), dict) and "gmm" in document:
        return "3"
    if "eigen_vectors_spatial" in document:
        return "1" if "mean_temporal_semantic_vector" in document else "2"
    return "static" if "spatial_coeffs" in document else None


@dataclass(frozen=True, eq=False)
class ModelParts:
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


def parts_of_model(document: Document, layout: Layout, file: str) -> ModelParts:
    """Collect the contents of a model document of any layout under the names of layout 3.

    Parameters
    ----------
    document : mapping    the document
    layout : str    its layout, as `layout_of` detects it
    file : str    name of the file, for messages

    Returns
    -------
    ModelParts    the contents; a missing time function or mixture is None

    Raises
    ------
    FormatError    naming the invalid field
    """
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
    maxima = model_numbers(
        document.get("translation_maxima", space.get("translation_maxima", [1, 1, 1])), file, "translation_maxima"
    )
    if maxima.shape != (3,):
        raise FormatError("field 'translation_maxima' must be three numbers", code="bad-number", file=file)
    return ModelParts(
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
    """Return the time part of a model, and the form of its time function.

    The returned part has one component per row; it is None if the model has no time part.

    Layout 2 was written by two training programs. The first program stores components as columns and uses the form
    `increments`; the later program stores components as rows and uses the form `coefficients`, as layout 3 does.
    """
    if time is None or not time.get("mean"):
        return None, "coefficients"
    count = len(field_of(time, "mean", list, file))
    if layout != "2":
        return time, "coefficients"
    vectors = model_numbers(time.get("eigen", []), file, _FLAT_TIME["eigen"])
    if vectors.ndim == 2 and vectors.shape[1] != count and vectors.shape[0] == count:
        return {**time, "eigen": vectors.T.tolist()}, "increments"
    return time, "coefficients"


def _keyframes(document: Document, file: str) -> dict[str, int]:
    if "keyframes" not in document:
        return {}
    given = field_of(document, "keyframes", dict, file)
    for label, frame in given.items():
        if not isinstance(frame, int) or isinstance(frame, bool) or frame < LAST_FRAME:
            raise FormatError(
                f"field 'keyframes': {label!r} must be the number of a frame, or {LAST_FRAME} for the last frame, not "
                f"{frame!r}",
                file=file,
            )
    return dict(given)


def model_numbers(values: Any, file: str, name: str) -> Floats:
    """Convert nested lists of numbers to an array.

    Parameters
    ----------
    values : list    numbers, or lists of equal length
    file, name : str    names of the file and of the field, for messages

    Returns
    -------
    ndarray of float    the numbers

    Raises
    ------
    FormatError    if the field is no array of numbers, or contains a number whose absolute value is greater than 1e12
    """
    numbers = number_array(values, file, name)
    if np.abs(numbers).max(initial=0.0) > MOST_NUMBER:
        raise FormatError(
            f"field {name!r} contains numbers that are larger than {MOST_NUMBER:g}", code="bad-number", file=file
        )
    return numbers

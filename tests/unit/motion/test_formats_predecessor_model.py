"""Motion primitives of Marey's predecessor: reading every file layout, and writing layouts 3 and 2."""

import copy
import dataclasses
import json
from typing import Any, Literal

import numpy as np
import pytest
from scipy.interpolate import BSpline
from tests.support import model_examples
from tests.support import predecessor_models as models

from marey_motion.arrays import Floats
from marey_motion.errors import FormatError, FormatLimit
from marey_motion.formats.predecessor import model
from marey_motion.formats.predecessor.encoding import Encoding, encode_document
from marey_motion.formats.predecessor.model import PredecessorModel, read_predecessor_model
from marey_motion.formats.predecessor.model_writer import write_predecessor_model
from marey_motion.formats.predecessor.time_functions import PredecessorTime, as_log_slopes
from marey_motion.modelling.splines import SplineBasis
from marey_motion.modelling.training import train_primitive
from marey_schemas.options.modelling import ModelOptions

QUICK = ModelOptions(leave_one_out=False, folds=0, report_samples=0)

SCORES = np.random.default_rng(3).normal(scale=0.3, size=(20, models.SPATIAL + models.TEMPORAL))


def read(document: dict[str, Any], encoding: Encoding = "json", **options: Any) -> PredecessorModel:
    return read_predecessor_model(encode_document(document, encoding), "model.json", **options)


def their_poses(document: dict[str, Any], scores: Floats) -> tuple[Floats, Floats]:
    """Return root positions in metres and rotations w, x, y, z, computed frame by frame as the predecessor does."""
    flat = "mean_spatial_vector" in document
    mean, vectors = (
        np.array(document[f"{name}_spatial{end}"] if flat else document["sspm"][name])
        for name, end in ((("mean"), "_vector"), ("eigen" if not flat else "eigen_vectors", ""))
    )
    maxima = document.get("translation_maxima", [1.0, 1.0, 1.0])
    knots = document["b_spline_knots_spatial"] if flat else document["sspm"]["knots"]
    coefficients = (mean + scores @ vectors).reshape(len(scores), models.COEFFICIENTS, -1)
    poses = BSpline(knots, coefficients.transpose(1, 0, 2), 3)(np.arange(models.FRAMES)).transpose(1, 0, 2)
    rotations = poses[..., 3:].reshape(*poses.shape[:2], -1, 4)
    rotations = rotations / np.linalg.norm(rotations, axis=-1, keepdims=True)
    return poses[..., :3] * maxima * 0.01 + models.SKELETON.offsets[0], rotations


@pytest.mark.parametrize("encoding", ["json", "bson", "bson.bz2"])
@pytest.mark.parametrize("layout", ["3", "2", "2 later", "1"])
def test_poses_are_those_of_the_document_in_metres_and_joints_that_are_not_animated_rest(
    layout: str, encoding: Encoding
) -> None:
    document = models.LAYOUTS[layout]()
    found = read(document, encoding)
    assert found.layout == layout[0]
    poses = found.primitive.poses(SCORES)
    root, rotations = their_poses(document, SCORES[:, : models.SPATIAL])
    np.testing.assert_allclose(poses[..., :3], root, atol=1e-9)
    ours = poses[..., 3:].reshape(*poses.shape[:2], -1, 4)
    np.testing.assert_allclose(ours[:, :, : len(models.ANIMATED)], rotations, atol=1e-9)
    resting = np.broadcast_to(models.SKELETON.rest_rotations, ours.shape)
    np.testing.assert_allclose(ours[:, :, len(models.ANIMATED) :], resting[:, :, len(models.ANIMATED) :], atol=1e-12)


def test_the_time_of_layout_3_is_a_spline_whose_coefficients_are_added_up_exponentials() -> None:
    document = models.layout_3()
    found = read(document)
    latents = found.primitive.sample(50, 1)
    scores = latents[:, models.SPATIAL :]
    part = document["tspm"]
    coefficients = np.cumsum(np.exp(np.array(part["mean"]) + scores @ np.array(part["eigen"])), axis=1) - 1.0
    theirs = BSpline(part["knots"], coefficients.T, 3)(np.arange(models.FRAMES)).T
    ours = found.primitive.time_functions(latents)
    assert found.time is not None
    assert found.time.form == "coefficients"
    assert 0.0 < found.time_error_frames < 1.0
    assert np.abs(ours - (theirs - theirs[:, :1])).max() < found.time_error_frames + 0.5
    assert found.primitive.frame_rate_hz == pytest.approx(72.0)
    assert found.primitive.keyframes == {"contact0": 20}


def test_time_parameters_of_layout_2_are_read_whichever_trainer_wrote_them() -> None:
    by_columns, by_rows = read(models.layout_2()), read(models.layout_2(by_columns=False))
    assert tuple(one.time.form for one in (by_columns, by_rows) if one.time) == ("increments", "coefficients")
    assert by_columns.time_error_frames < 1e-9
    document = models.layout_2()
    scores = by_columns.primitive.sample(5, 2)[:, models.SPATIAL :]
    logarithms = np.array(document["mean_time_vector"]) + scores @ np.array(document["eigen_vectors_time"]).T
    steps = np.exp(BSpline(document["b_spline_knots_time"], logarithms.T, 3)(np.arange(1, models.FRAMES)).T)
    ours = by_columns.primitive.time_functions(by_columns.primitive.sample(5, 2))
    np.testing.assert_allclose(np.diff(ours, axis=1), steps, rtol=1e-9)


def test_layout_1_tells_time_as_layout_3_does() -> None:
    found = read(models.layout_1())
    assert found.time is not None
    assert found.time.form == "coefficients"
    assert found.primitive.temporal.count == models.TEMPORAL


def test_a_static_primitive_is_always_the_same_motion_at_constant_speed() -> None:
    found = read(models.static())
    assert found.primitive.dimensions == 0
    first, second = found.primitive.motions(found.primitive.sample(2, 5))
    np.testing.assert_array_equal(first.rotations, second.rotations)
    assert first.frame_count == models.FRAMES
    assert found.time is None


def test_a_mixture_of_space_alone_leaves_time_at_its_mean() -> None:
    document = models.layout_3()
    weights, means, covariances = models.mixture(np.random.default_rng(1), models.SPATIAL)
    document["gmm"] = {"weights": weights, "means": means, "covars": covariances}
    found = read(document)
    assert (found.primitive.spatial.count, found.primitive.temporal.count) == (models.SPATIAL, 0)
    durations = found.primitive.durations_s(found.primitive.sample(10, 0))
    assert np.ptp(durations) == 0.0


def test_a_model_without_time_runs_at_constant_speed() -> None:
    document = models.layout_3()
    weights, means, covariances = models.mixture(np.random.default_rng(1), models.SPATIAL)
    document |= {"tspm": {}, "gmm": {"weights": weights, "means": means, "covars": covariances}}
    times = read(document).primitive.time_functions(read(document).primitive.sample(2, 0))
    np.testing.assert_allclose(times, np.broadcast_to(np.arange(models.FRAMES), times.shape), atol=1e-9)


def test_a_model_without_its_skeleton_needs_one() -> None:
    document = models.layout_2()
    del document["skeleton"]
    with pytest.raises(FormatError) as refused:
        read(document)
    assert refused.value.code == "skeleton-missing"
    given = read(document, skeleton=models.SKELETON)
    np.testing.assert_array_equal(given.primitive.spatial.mean, read(models.layout_2()).primitive.spatial.mean)


def test_the_oldest_models_tell_how_many_coefficients_there_are_in_place_of_knots() -> None:
    document = models.layout_2()
    without = {name: value for name, value in document.items() if "knots" not in name}
    np.testing.assert_array_equal(
        read(without).primitive.spatial.basis.knots, read(document).primitive.spatial.basis.knots
    )


@pytest.mark.parametrize("layout", ["3", "2"])
def test_what_is_written_in_a_layout_is_read_as_the_same_model(layout: Literal["2", "3"]) -> None:
    primitive = read(models.layout_3()).primitive
    again = read_predecessor_model(write_predecessor_model(primitive, layout=layout), "again.json")
    assert again.layout == layout
    latents = primitive.sample(20, 4)
    np.testing.assert_allclose(again.primitive.poses(latents), primitive.poses(latents), atol=1e-9)
    np.testing.assert_allclose(again.primitive.mixture.means, primitive.mixture.means)
    ours, theirs = (one.time_functions(latents) for one in (primitive, again.primitive))
    assert np.abs(ours - theirs).max() < 1.5
    assert np.abs(primitive.durations_s(latents) - again.primitive.durations_s(latents)).max() < 1.0 / 72.0
    assert again.primitive.keyframes == primitive.keyframes


@pytest.mark.parametrize(("layout", "most_frames"), [("3", 0.3), ("2", 1e-3)])
def test_time_varies_as_much_after_writing(layout: Literal["2", "3"], most_frames: float) -> None:
    trained = train_primitive(model_examples.walks(24), QUICK).primitive
    again = read_predecessor_model(write_predecessor_model(trained, layout=layout), "again.json").primitive
    latents = trained.sample(50, 4)
    # Files of the predecessor hold no ranges of time: the motions of the first model are not held to them either.
    free = dataclasses.replace(trained, duration_range_s=None, log_slope_range=None)
    before, after = (one.time_functions(latents) for one in (free, again))
    assert np.ptp(before[:, -1]) > 50.0
    assert np.abs(after - before).max() < most_frames


def test_layout_3_is_written_with_the_numbers_that_were_read() -> None:
    document = models.layout_3()
    found = read(document)
    written = json.loads(
        write_predecessor_model(found.primitive, animated_joints=found.animated_joints, time=found.time)
    )
    for name in ("eigen", "mean", "knots"):
        np.testing.assert_allclose(written["sspm"][name], document["sspm"][name], atol=1e-9)
    for name in ("n_coeffs", "n_dims", "degree", "animated_joints"):
        assert written["sspm"][name] == document["sspm"][name]
    np.testing.assert_allclose(written["gmm"]["covars"], document["gmm"]["covars"], rtol=1e-12)
    roots = np.array(written["gmm"]["eigen"])
    np.testing.assert_allclose(roots @ roots.transpose(0, 2, 1), document["gmm"]["covars"], atol=1e-12)
    assert written["tspm"] == document["tspm"] | {"frame_time": pytest.approx(1.0 / 72.0)}
    assert written["keyframes"] == document["keyframes"]


@pytest.mark.parametrize("layout", ["3", "2"])
def test_a_model_that_only_repeats_one_motion_is_written_and_read_again(layout: Literal["2", "3"]) -> None:
    primitive = read(models.static()).primitive
    again = read_predecessor_model(write_predecessor_model(primitive, layout=layout), "again.json").primitive
    assert again.dimensions == 1  # a component of zeros: the predecessor's reader rejects an empty mixture
    np.testing.assert_allclose(again.poses(np.ones((1, 1))), primitive.poses(np.zeros((1, 0))), atol=1e-9)
    np.testing.assert_allclose(again.time_functions(np.ones((1, 1)))[0], np.arange(models.FRAMES), atol=1e-6)


def test_keyframes_at_the_end_of_the_motion_are_read_as_its_last_frame() -> None:
    found = read(models.layout_3() | {"keyframes": {"contact0": 20, "contact1": 48, "contact2": 61, "contact3": -1}})
    assert found.primitive.keyframes == {"contact0": 20, "contact1": 47, "contact2": 47, "contact3": 47}
    assert found.moved_keyframes == ("contact1", "contact2", "contact3")


@pytest.mark.parametrize("frames", [3, 4, 5, 6, 48, 400])
def test_a_time_function_is_taken_over_as_it_is_however_long(frames: int) -> None:
    basis = SplineBasis.clamped(frames, min(frames, 8), min(3, frames - 1))
    time = PredecessorTime("increments", basis, np.linspace(-1.0, 1.0, basis.count) ** 2, np.zeros((0, basis.count)))
    found, error = as_log_slopes(time, np.zeros((1, 0)), np.zeros(0), "model.json")
    steps = np.diff(time.time_functions(np.zeros((1, 0))), axis=1)
    np.testing.assert_allclose(found.basis.at_frames @ found.mean[:, 0], np.log(steps)[0], atol=1e-11)
    assert error < 1e-10 * frames


def test_a_long_time_function_is_taken_over_without_a_coefficient_for_each_frame() -> None:
    document = models.static()
    document["knots"] = SplineBasis.clamped(6000, models.COEFFICIENTS).knots.tolist()
    found = read(document)
    assert found.primitive.temporal.basis.count < 510
    times = found.primitive.time_functions(np.zeros((1, 0)))[0]
    np.testing.assert_allclose(times, np.arange(6000), atol=1e-6)


def changed(path: list[str], value: object) -> dict[str, Any]:
    document = copy.deepcopy(models.layout_3())
    *above, last = path
    place = document
    for step in above:
        place = place[step]
    place[last] = value
    return document


@pytest.mark.parametrize(
    ("document", "told"),
    [
        ({"poses": []}, "not a model"),
        (changed(["sspm", "mean"], [1.0, 2.0]), "space: the mean has 2 numbers, which is not a multiple of the 9"),
        (changed(["sspm", "n_coeffs"], 7), "n_coeffs is 7"),
        (changed(["sspm", "n_dims"], 7), "`n_dims` is 7"),
        (changed(["sspm", "knots"], [0.0] * 13), "must not decrease, and must span a range"),
        (changed(["sspm", "knots"], "x"), "'knots' must be list"),
        (changed(["sspm", "degree"], 99), "degree of the spline is 99"),
        (changed(["sspm", "eigen"], [[1.0]]), r"eigenvectors have the shape \(1, 1\)"),
        (changed(["sspm", "mean"], [float("1e400")] * 459), "mean"),
        (changed(["sspm", "animated_joints"], ["Hips"]), "51 channels, but 1 joints need 7"),
        (
            changed(["sspm", "animated_joints"], [*models.ANIMATED[:-1], "Tail"]),
            "joint Tail: the skeleton has no joint of this",
        ),
        (changed(["tspm", "mean"], [50.0] * 8), "its slope is too steep or too flat"),
        (changed(["gmm", "weights"], [0.4, 0.4]), "add up to 1"),
        (changed(["gmm", "covars"], np.zeros((2, 8, 8)).tolist()), "not positive definite"),
        (changed(["gmm", "covars"], np.eye(8).tolist()), "of weights, means and covars, .* do not fit"),
        (changed(["gmm"], {"weights": [1.0], "means": [[0.0] * 9], "covars": [np.eye(9).tolist()]}), "9 dimensions"),
        (changed(["keyframes"], {"contact0": -2}), "'contact0' must be the number of a frame, or -1 .* not -2"),
        (changed(["keyframes"], {"contact0": 1.5}), "'contact0' must be the number of a frame, or -1 .* not 1.5"),
        (changed(["tspm", "frame_time"], "x"), "'frame_time' must be .* not 'x'"),
        (changed(["tspm"], 5), "'tspm' must be dict, not int"),
        (changed(["tspm"], [1]), "'tspm' must be dict, not list"),
        (changed(["tspm", "mean"], 3), "'mean' must be list, not int"),
        (changed(["sspm", "degree"], True), "degree of the spline is True"),
        (changed(["sspm", "mean"], [1e308] * 459), "'space: mean' contains numbers that are larger than 1e.12"),
        (changed(["sspm", "knots"], [0.0] * 4 + [5.0] * 2000 + [19_999.0] * 4), "2004 coefficients over 20000 frames"),
    ],
)
def test_damaged_models_are_refused_by_what_is_wrong(document: dict[str, Any], told: str) -> None:
    data = json.dumps(document).encode()
    with pytest.raises(FormatError, match=told) as refused:
        read_predecessor_model(data, "model.json")
    assert refused.value.file == "model.json"


def test_a_small_model_on_a_large_skeleton_is_refused_before_it_fills_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    data = json.dumps(models.layout_3()).encode()
    read_predecessor_model(data, "model.json")
    monkeypatch.setattr(model, "MOST_VALUES", 4000)
    with pytest.raises(FormatLimit, match="5 components of 9 coefficients for 26 joints have 4,815 numbers"):
        read_predecessor_model(data, "model.json")

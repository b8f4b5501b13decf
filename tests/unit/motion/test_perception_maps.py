"""Perceptual distances of frames: measurements, shapings, published weights, axioms, units and motion maps."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any, get_args

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.gait import game_skeleton, generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.perception import maps
from marey_motion.perception.maps import component_map, joint_differences, map_blocks, motion_map, paired_distances
from marey_motion.perception.measuring import MeasuredClip, classes_measured, measure_motion
from marey_motion.perception.metric import (
    Component,
    PerceptualMetric,
    metric_of,
    published_metric,
    uniform_metric,
)
from marey_motion.rigs import map_joints
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.metrics import (
    MEASUREMENTS,
    PUBLISHED,
    AngleMeasure,
    Measurement,
    Shaping,
    built_in_metric,
    classes_of,
)

KINDS: tuple[tuple[Measurement, Shaping], ...] = tuple(product(MEASUREMENTS, get_args(Shaping)))


def measured(clip: Clip, motion: Motion | None = None) -> MeasuredClip:
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    return measure_motion(motion or Motion.of(clip), body, clip.frame_rate_hz)


@cache
def walks() -> tuple[MeasuredClip, MeasuredClip]:
    return measured(generate_gait(1.3, 0.2, 1.2)), measured(generate_gait(2.1, -0.4, 0.9))


def one_component(component: Component, **options: Any) -> PerceptualMetric:
    return replace(PerceptualMetric("one", (component,), (1.0,)), **options)


def published(measurement: str, shaping: str) -> Component:
    return metric_of(built_in_metric(f"published/{measurement}-{shaping}")).components[0]


def test_the_published_table_is_as_printed() -> None:
    sums = {}
    for measurement, rows in PUBLISHED.items():
        for shaping, (difference, constant, norm, *weights) in rows.items():
            assert None not in (difference, constant, norm)
            assert len(weights) == 8
            assert [weight is None for weight in weights] == [
                measurement == "angles" and name in ("hand", "toe") for name in classes_of("positions")
            ]
            component = published(measurement, shaping)
            sums[measurement, shaping] = sum(component.weights.values())
            assert component.shares_of(classes_of(measurement)).sum() == pytest.approx(1.0, abs=1e-15)
    odd = {which: round(total, 3) for which, total in sums.items() if abs(total - 1.0) > 0.0015}
    assert odd == {("positions", "sigmoid"): 0.998, ("velocities", "sigmoid"): 1.027}
    assert "1.027" in built_in_metric("published/velocities-sigmoid").notes[0]
    assert not built_in_metric("published/angles-euclid").notes
    assert published("velocities", "sigmoid").weights["thigh"] == 0.0
    # The mean of the experiment's table is 5/6, so these are the typical differences of a joint.
    expected: dict[Measurement, tuple[float, ...]] = {
        "angles": (0.0222, 0.0261, 0.0267),
        "positions": (0.0513, 0.0771, 0.0807),
    }
    expected["velocities"] = (0.0145, 0.0174, 0.0180)
    for measured_by, numbers in expected.items():
        raw = [(5 / 6 - float(row[1] or 0)) / float(row[2] or 0) for row in PUBLISHED[measured_by].values()]
        assert (np.sqrt(raw[0]), raw[1], raw[2] / (1 - raw[2])) == pytest.approx(numbers, abs=2.5e-4)


def brute_force(a: MeasuredClip, b: MeasuredClip, component: Component, metric: PerceptualMetric) -> Floats:
    """Compute a map cell by cell and joint by joint, as the formulas are written."""
    found = np.empty((a.frame_count, b.frame_count))
    names = classes_measured(a, component.measurement)
    weights = dict(zip(names, component.shares_of(names), strict=True))
    for i, j in product(range(a.frame_count), range(b.frame_count)):
        total = 0.0
        for k, name in enumerate(a.classes):
            points = range(a.starts[k], a.starts[k + 1])
            if name in weights:
                sides = [joint_difference(a, b, i, j, p, component, metric) for p in points]
                x = sum(sides) / (len(sides) if metric.side_reduce == "mean" else 1)
                shapes = {"euclid": x**2, "manhattan": x, "sigmoid": x / (x + 1), "power": x**component.exponent}
                total += weights[name] * shapes[component.shaping]
        found[i, j] = component.norm * total + component.constant * (total > 0)
    return found


def joint_difference(
    a: MeasuredClip, b: MeasuredClip, i: int, j: int, p: int, component: Component, metric: PerceptualMetric
) -> float:
    if component.measurement == "angles":
        angle = (Rotation.from_quat(a.rotations[i, p, [1, 2, 3, 0]]).inv()
                 * Rotation.from_quat(b.rotations[j, p, [1, 2, 3, 0]])).magnitude()  # fmt: skip
        dot = abs(float(a.rotations[i, p] @ b.rotations[j, p]))
        by_kind = {"half_angle": angle / 2, "angle": angle, "one_minus_dot": 1 - dot, "log_norm": angle / 2}
        return float(by_kind[metric.angle])
    if component.measurement == "velocities":
        return float(np.linalg.norm(a.velocities[i, p] - b.velocities[j, p])) / 30.0
    return float(np.linalg.norm(a.positions[i, p] - b.positions[j, p])) / metric.length_unit_m


@pytest.mark.every_nth(3)
@pytest.mark.parametrize(("measurement", "shaping"), KINDS)
def test_maps_are_those_of_the_formulas(measurement: Measurement, shaping: Shaping) -> None:
    a, b = (clip.at(np.arange(0.0, 40.0, 5.5)) for clip in walks())
    weights = {name: 1.0 + k for k, name in enumerate(classes_of(measurement))}
    component = Component(measurement, shaping, 0.2, 7.0, weights, exponent=0.3)
    for options in ({}, {"side_reduce": "sum"}, *({"angle": kind} for kind in get_args(AngleMeasure))):
        metric = one_component(component, **options)
        expected = brute_force(a, b, component, metric)
        np.testing.assert_allclose(component_map(a, b, metric, component), expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(paired_distances(a, b, metric), np.diag(expected), rtol=1e-9, atol=1e-9)


def turned(points: Floats, angle: float) -> Floats:
    turn = quaternions.from_axis_angle((0.0, 1.0, 0.0), angle)
    return np.asarray(quaternions.rotate_vectors(turn, points), dtype=np.float64)


def squares_after_turn(angle: float, one: Floats, other: Floats) -> float:
    return float(np.sum((one - turned(other, angle)) ** 2))


def test_kovar_alignment_is_the_best_rotation_and_shift() -> None:
    a, b = (clip.at(np.arange(0.0, 40.0, 13.0)) for clip in walks())
    squares = Component("positions", "euclid", 0.0, 1.0, {"calf": 1.0})
    metric = one_component(squares, root_alignment="kovar2d")
    calves = slice(a.starts[a.classes.index("calf")], a.starts[a.classes.index("calf") + 1])
    expected = np.empty((len(a.positions), len(b.positions)))
    for i, j in np.ndindex(expected.shape):
        one, other = (each - each.mean(axis=0) * (1, 0, 1) for each in (a.positions[i], b.positions[j]))

        angles = np.linspace(-np.pi, np.pi, 73)
        near = angles[np.argmin([squares_after_turn(angle, one, other) for angle in angles])]
        bounds, exact = (near - 0.1, near + 0.1), {"xatol": 1e-12}
        best = minimize_scalar(squares_after_turn, bounds=bounds, args=(one, other), method="bounded", options=exact)
        expected[i, j] = np.linalg.norm((one - turned(other, best.x))[calves], axis=1).mean() ** 2
    np.testing.assert_allclose(motion_map(a, b, metric), expected, rtol=1e-5)
    np.testing.assert_allclose(paired_distances(a, b, metric), np.diag(expected), rtol=1e-5)


@pytest.mark.parametrize(("measurement", "shaping"), KINDS)
def test_distances_of_frames_obey_the_axioms_of_a_metric(measurement: Measurement, shaping: Shaping) -> None:
    clip = walks()[0].at(np.arange(0.0, 60.0, 2.3))
    weights = dict.fromkeys(classes_of(measurement), 1.0)
    found = motion_map(clip, clip, one_component(Component(measurement, shaping, 0.3, 5.0, weights, exponent=0.7)))
    assert (np.diag(found) == 0.0).all()
    np.testing.assert_allclose(found, found.T, rtol=1e-13)
    assert found[~np.eye(len(found), dtype=bool)].min() > 0.3
    if shaping != "euclid":
        assert (found[:, None, :] <= found[:, :, None] + found[None, :, :] + 1e-12).all()


def test_squares_violate_the_triangle_inequality_and_the_constant_can_apply_to_equal_poses() -> None:
    clip = walks()[0].at(np.zeros(3))
    clip.positions[:, :, 0] = np.array([[0.0], [0.1], [0.2]])
    square = Component("positions", "euclid", 0.0, 1.0, {"head": 1.0})
    found = motion_map(clip, clip, one_component(square))
    assert found[0, 2] - found[0, 1] - found[1, 2] == pytest.approx(0.02)
    kept = one_component(replace(square, constant=0.4), identity="constant")
    assert np.diag(motion_map(clip, clip, kept)).tolist() == [0.4, 0.4, 0.4]


def test_signs_place_and_heading_make_no_difference() -> None:
    gait = generate_gait(1.3, 0.4, 1.5)
    motion, turn = Motion.of(gait), quaternions.from_axis_angle((0.0, 1.0, 0.0), 2.1)
    rotations = motion.rotations.copy()
    rotations[:, 0] = quaternions.multiply(turn, rotations[:, 0])
    places = np.array((30.0, 0.0, -70.0)) + np.asarray(
        quaternions.rotate_vectors(turn, motion.root_translations), np.float64
    )
    moved = measured(gait, motion._replace(root_translations=places, rotations=-rotations))
    at_home = measured(gait)
    np.testing.assert_allclose(moved.positions, at_home.positions, atol=1e-12)
    plain = [
        replace(metric, identity="constant") for metric in (published_metric("manhattan"), uniform_metric("sigmoid"))
    ]
    for metric in plain:
        np.testing.assert_allclose(motion_map(moved, at_home, metric), motion_map(at_home, at_home, metric), atol=1e-10)


def test_units_change_n_by_their_powers_except_for_the_sigmoid() -> None:
    a, b = walks()
    factors = {}
    shapings: tuple[Shaping, ...] = ("manhattan", "euclid", "sigmoid")
    for shaping in shapings:
        component = Component("positions", shaping, 0.0, 1.0, {"forearm": 1.0})
        ratio = motion_map(a, b, one_component(component, length_unit_m=0.01)) / motion_map(
            a, b, one_component(component)
        )
        factors[shaping] = ratio.min(), ratio.max()
    assert factors["manhattan"] == pytest.approx((100.0, 100.0), rel=1e-12)
    assert factors["euclid"] == pytest.approx((1e4, 1e4), rel=1e-12)
    assert factors["sigmoid"][1] > 1.2 * factors["sigmoid"][0]


def test_long_maps_come_in_blocks_and_bad_input_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = walks()
    metric = published_metric()
    whole = motion_map(a, b, metric)
    parts = [
        share * component_map(a, b, metric, component)
        for share, component in zip(metric.shares, metric.components, strict=True)
    ]
    np.testing.assert_allclose(whole, sum(parts), rtol=1e-13)
    monkeypatch.setattr(maps, "_BLOCK_CELLS", 7 * b.frame_count)
    blocks = list(map_blocks(a, b, metric))
    assert [start for start, _ in blocks] == list(range(0, a.frame_count, 7))
    np.testing.assert_array_equal(np.concatenate([block for _, block in blocks]), whole)
    monkeypatch.setattr(maps, "MOST_CELLS", 10)
    refused: dict[str, Callable[[], object]] = {
        "map-too-large": lambda: motion_map(a, b, metric),
        "frame-rates-differ": lambda: next(map_blocks(a, replace(b, rate_hz=30.0), metric)),
        "skeletons-differ": lambda: next(map_blocks(a, replace(b, skeleton=game_skeleton()), metric)),
        "mapping-invalid": lambda: published("velocities", "manhattan").shares_of(("head", "thigh")),
    }
    for code, call in refused.items():
        with pytest.raises(MotionError) as error:
            call()
        assert error.value.code == code
    wrong_metrics: tuple[Callable[[], object], ...] = (
        lambda: Component("angles", "euclid", 0.0, 1.0, {"hand": 1.0}),
        lambda: Component("angles", "euclid", np.nan, 1.0, {"head": 1.0}),
        lambda: Component("angles", "power", 0.0, 1.0, {"head": 1.0}, exponent=0.0),
        lambda: published_metric("power"),
        lambda: replace(metric, shares=(0.5, 0.6, -0.1)),
        lambda: replace(metric, length_unit_m=0.0),
        lambda: replace(metric, shares=(1.0,)),
    )
    for wrong in wrong_metrics:
        with pytest.raises(MotionError):
            wrong()


def test_a_skeleton_without_some_joints_is_compared_by_the_others() -> None:
    gait = generate_gait(1.3, 0.0, 1.0)
    full = gait.skeleton
    fewer = full.joint_names.index("LeftToeBase"), full.joint_names.index("RightToeBase")
    assert isinstance(full, Skeleton)
    body = MatchingBody.from_mapping(full, map_joints(full))
    known = {name: joint for name, joint in body.standard_joints.items() if joint not in fewer}
    clip = measure_motion(Motion.of(gait), replace(body, standard_joints=known), 60.0)
    assert "toe" not in clip.classes
    component = published("positions", "manhattan")
    found = joint_differences(clip, clip.at(np.arange(60.0)[::-1]), one_component(component), component)
    assert found.shape == (60, 7)
    assert component.shares_of(clip.classes)[clip.classes.index("upper_arm")] == pytest.approx(0.362 / 0.811)

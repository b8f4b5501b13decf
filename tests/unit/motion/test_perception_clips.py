"""Perceptual distances of clips: registration curves, periods, loops without a seam; also on real walks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from marey_motion.alignment.warp import warped
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.formats import read_motion
from marey_motion.gait import generate_gait
from marey_motion.looping import continue_motion
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.perception.cycles import cut_loop, find_period
from marey_motion.perception.maps import motion_map
from marey_motion.perception.measuring import MeasuredClip, measure_motion
from marey_motion.perception.metric import PerceptualMetric, published_metric
from marey_motion.perception.registration import (
    clip_distance,
    differences_along_curve,
    increasing_spline,
    neighbourhood_costs,
    registration_curve,
)
from marey_motion.rigs import map_joints

METRIC = published_metric()


def without_constants(metric: PerceptualMetric) -> PerceptualMetric:
    return replace(metric, components=tuple(replace(each, constant=0.0) for each in metric.components))


def body_of(clip: Clip) -> MatchingBody:
    return MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))


def loop_of(clip: Clip) -> tuple[Motion, MeasuredClip]:
    motion, body = Motion.of(clip), body_of(clip)
    period = find_period(measure_motion(motion, body, clip.frame_rate_hz), METRIC)
    loop, seam = cut_loop(motion, body, period)
    return loop, measure_motion(loop, body, clip.frame_rate_hz, seam=seam)


def test_a_clip_corresponds_to_itself_and_a_shifted_cycle_to_its_shift() -> None:
    _, loop = loop_of(generate_gait(1.4, 0.3, 5.0))
    n = loop.frame_count
    for clip in (loop, replace(loop, cyclic=False)):
        curve = registration_curve(clip, clip, METRIC)
        np.testing.assert_array_equal(curve.path, np.stack([np.arange(n)] * 2, axis=1))
        np.testing.assert_allclose(curve.times, np.arange(n), atol=1e-9)
        assert clip_distance(clip, clip, METRIC).total == 0.0
    later = loop.at(17.0 + np.arange(n, dtype=np.float64))
    curve = registration_curve(loop, later, METRIC)
    assert curve.shift == n - 17
    assert clip_distance(loop, later, METRIC).total == 0.0
    assert clip_distance(replace(loop, cyclic=False), replace(later, cyclic=False), METRIC).total > 0.3


def test_a_warped_copy_is_found_and_its_distance_falls_with_the_frame_rate() -> None:
    gait = generate_gait(1.4, 0.0, 2.0)
    body, plain = body_of(gait), without_constants(published_metric("manhattan"))
    positions = replace(plain, components=plain.components[1:2], shares=(1.0,))
    distances = []
    for rate in (30.0, 60.0, 120.0):
        share = np.linspace(0.0, 1.0, round(2 * rate) - 1)
        one = measure_motion(warped(Motion.of(gait), share * (gait.frame_count - 1)), body, rate)
        times = (share + 0.03 * np.sin(2 * np.pi * share)) * (len(share) - 1)
        other = one.at(times)
        curve = registration_curve(other, one, positions)
        off = np.abs(curve.times - times)
        ends = round(rate / 6)  # there, the neighbourhood of a frame is on one side of it
        assert off[ends:-ends].max() <= max(1.0, 0.0125 * rate), rate
        assert off.max() <= 2.0, rate
        assert (np.diff(curve.times) > 0).all()
        distances.append(clip_distance(one, other, positions).total)
    assert distances[0] > distances[1] > distances[2]
    assert distances[2] < 0.03


def test_distances_of_clips_are_symmetric_and_add_each_constant_once() -> None:
    slow, fast = (loop_of(generate_gait(speed, 0.0, 5.0))[1] for speed in (1.1, 1.6))
    there, back = clip_distance(slow, fast, METRIC), clip_distance(fast, slow, METRIC)
    assert there.total == pytest.approx(back.total, rel=1e-14)
    bare = clip_distance(slow, fast, without_constants(METRIC))
    constants = [component.constant for component in METRIC.components]
    assert np.subtract(there.by_component, bare.by_component).tolist() == pytest.approx(constants, abs=0.02)
    assert there.total == pytest.approx(np.dot(METRIC.shares, there.by_component))
    along = differences_along_curve(slow, fast, METRIC)
    assert [each.shape for each in along] == [(slow.frame_count + fast.frame_count, k) for k in (6, 8, 8)]


def test_costs_are_means_along_diagonals() -> None:
    costs = np.random.default_rng(3).random((9, 7))
    for cyclic in (False, True):
        expected = np.empty_like(costs)
        for i, j in np.ndindex(*costs.shape):
            steps = [s for s in (-2, -1, 0, 1, 2) if cyclic or (0 <= i + s < 9 and 0 <= j + s < 7)]
            expected[i, j] = np.mean([costs[(i + s) % 9, (j + s) % 7] for s in steps])
        np.testing.assert_allclose(neighbourhood_costs(costs, 2, cyclic=cyclic), expected)


@pytest.mark.parametrize("seed", range(8))
def test_splines_increase_strictly_and_keep_the_ends(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.choice([0.01, 0.3, 1.0, 4.0], size=5 + 12 * seed, p=[0.4, 0.2, 0.2, 0.2])
    times = np.concatenate(([0.0], np.cumsum(steps)))
    spline = increasing_spline(times, 60.0)
    assert np.diff(spline).min() > 0
    assert spline[[0, -1]] == pytest.approx(times[[0, -1]], abs=1e-9)
    np.testing.assert_allclose(increasing_spline(np.arange(40.0) * 1.5, 60.0), np.arange(40.0) * 1.5, atol=1e-9)


def worst_step(motion: Motion, clip: Clip, rounds: Motion) -> tuple[float, float]:
    """Return the greatest second difference of joint positions at the seam, and within the loop, in metres."""
    places = rounds.positions(clip.skeleton)
    jerks = np.abs(np.diff(places, n=2, axis=0)).max(axis=(1, 2))
    n = motion.frame_count
    return float(jerks[n - 2 : n].max()), float(jerks[: n - 2].max())


def check_loop(clip: Clip, expected_frames: float | None) -> None:
    motion, body = Motion.of(clip), body_of(clip)
    clip_measured = measure_motion(motion, body, clip.frame_rate_hz)
    period = find_period(clip_measured, METRIC)
    if expected_frames is not None:
        assert abs(period.frames - expected_frames) <= 1
    loop, seam = cut_loop(motion, body, period)
    closed = continue_motion(loop, seam, 0, loop.frame_count)
    at_seam, inside = worst_step(loop, clip, closed)
    assert at_seam <= 1.2 * inside
    # Both ends of the loop are the same frame of the clip.
    end = motion.at_frames(np.array([period.start + period.frames]))
    repeated = closed.at_frames(np.array([loop.frame_count]))
    limbs = slice(body.carrier + 1, None)
    for one in (loop.at_frames(np.array([0])), repeated):
        assert np.abs(np.sum(one.rotations[:, limbs] * end.rotations[:, limbs], axis=-1)).min() > 1.0 - 1e-9
    cyclic = measure_motion(loop, body, clip.frame_rate_hz, seam=seam)
    assert clip_distance(cyclic, cyclic, METRIC).total == 0.0


def test_a_repeated_cycle_has_its_period_and_the_loop_closes() -> None:
    gait = generate_gait(1.3, 0.2, 4.0)
    loop, _ = loop_of(gait)
    motion, body = Motion.of(gait), body_of(gait)
    seam = cut_loop(motion, body, find_period(measure_motion(motion, body, 60.0), METRIC))[1]
    repeated = continue_motion(loop, seam, 0, 2 * loop.frame_count + 20)
    check_loop(repeated.as_clip(gait.skeleton, 60.0), loop.frame_count)


def test_motions_without_period_are_refused() -> None:
    gait = generate_gait(1.3, 0.0, 4.0)
    body = body_of(gait)
    still = measure_motion(Motion.of(gait).at_frames(np.zeros(240, np.int64)), body, 60.0)
    short = measure_motion(Motion.of(gait).sliced(0, 50), body, 60.0)
    for clip in (still, short):
        with pytest.raises(MotionError) as error:
            find_period(clip, METRIC)
        assert error.value.code == "no-period"


REAL = (
    "bandai-namco-1/dataset-1_walk_normal_001.bvh",
    "bandai-namco-2/dataset-2_walk_active_001.bvh",
    "cmu-amc/07/07_01-walk.amc",
    "cmu-amc/02/02_01.amc",
)


def real_clip(mocap: Path, name: str) -> Clip:
    companion = mocap / name.replace(Path(name).name, f"{Path(name).stem[:2]}.asf") if name.endswith("amc") else None
    data = companion.read_bytes() if companion else None
    clip = read_motion((mocap / name).read_bytes(), name, companion=data).clip
    assert clip is not None
    return clip


@pytest.mark.parametrize("name", REAL)
def test_real_walks_become_loops(mocap: Path, name: str) -> None:
    clip = real_clip(mocap, name)
    check_loop(clip, None)
    measured = measure_motion(Motion.of(clip), body_of(clip), clip.frame_rate_hz)
    found: Floats = motion_map(measured, measured, METRIC)
    assert (np.diag(found) == 0).all()
    np.testing.assert_allclose(found, found.T, rtol=1e-12)

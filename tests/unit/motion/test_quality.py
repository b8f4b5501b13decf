"""Quality of motion on clips with known numbers and on recorded walks, compared with loops of published formulas."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import MappingError, MotionError
from marey_motion.formats import read_motion
from marey_motion.gait import generate_gait, studio_skeleton
from marey_motion.kinematics import global_positions
from marey_motion.quality.feet import (
    Feet,
    contact_consistency,
    skate_by_contact,
    skate_by_height,
    skate_ratio,
    weighted_skate,
)
from marey_motion.quality.measuring import QualityBody, measure_quality
from marey_motion.quality.totals import changes_from, total_over_clips
from marey_motion.rigs import guess_axes, map_joints
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.quality import MEASURES
from marey_schemas.options.quality import QualityOptions

RATE = 30.0
OPTIONS = QualityOptions()


def body_of(skeleton: Skeleton) -> QualityBody:
    mapping = map_joints(skeleton)
    return QualityBody.of(skeleton, mapping, guess_axes(skeleton, mapping))


def standing(frames: int = 61, rate: float = RATE) -> Clip:
    """A body that stands still, with its lowest joint or bone's end at height 0."""
    skeleton = studio_skeleton()
    pose = np.concatenate((skeleton.offsets[0], skeleton.rest_rotations.ravel()))
    clip = Clip(skeleton, rate, np.tile(pose, (frames, 1)).astype(np.float32))
    lowest = float(global_positions(clip, end_sites=True)[0, :, 1].min())
    return moved(clip, lambda _: (0.0, -lowest, 0.0))


def moved(clip: Clip, way: Callable[[Floats], Sequence[float | Floats]]) -> Clip:
    """Return the clip with the root moved by `way` (x, y, z), a function of the time in seconds."""
    poses = clip.poses.astype(np.float64)
    for axis, offset in enumerate(way(np.arange(clip.frame_count) / clip.frame_rate_hz)):
        poses[:, axis] += offset
    return replace(clip, poses=poses.astype(np.float32))


def turned(clip: Clip, joint: str, axis: Sequence[float], angle_deg: float) -> Clip:
    """Return the clip with a joint rotated about an axis of its own frame."""
    poses, place = clip.poses.copy(), 3 + 4 * clip.skeleton.index_of(joint)
    half = np.radians(angle_deg) / 2.0
    rotation = np.concatenate(([np.cos(half)], np.sin(half) * np.asarray(axis)))
    poses[:, place : place + 4] = quaternions.multiply(poses[:, place : place + 4].astype(np.float64), rotation)
    return replace(clip, poses=poses)


def measured(clip: Clip, **options: object) -> dict[str, float | None]:
    return dict(measure_quality(clip, body_of(clip.skeleton), OPTIONS.replace(**options)).values)


def test_a_still_figure_has_no_defect() -> None:
    values = measured(standing())
    assert tuple(values) == tuple(MEASURES)
    ones = ("contact_consistency", "near_floor_share")
    assert {name: value for name, value in values.items() if abs(value or 0.0) > 1e-6} == dict.fromkeys(ones, 1.0)


@pytest.mark.parametrize("speed", [0.1, 0.3])
def test_a_figure_that_glides_skates_at_its_speed_by_each_definition(speed: float) -> None:
    values = measured(moved(standing(), lambda t: (0.6 * speed * t, 0.0, 0.8 * speed * t)))
    for name in ("skate_weighted_m_s", "skate_height_m_s", "skate_contact_m_s", "speed_m_s"):
        assert values[name] == pytest.approx(speed, rel=1e-4), name
    assert values["skate_ratio"] == float(speed > OPTIONS.skate_speed_m_s)
    assert values["contact_consistency"] == float(speed < OPTIONS.contact_speed_m_s)
    assert values["jitter_m_s3"] == pytest.approx(0.0, abs=0.05)


def test_a_fast_glide_is_no_contact_but_skates_by_height() -> None:
    values = measured(moved(standing(), lambda t: (0.0 * t, 0.0, 2.0 * t)))
    assert values["skate_contact_m_s"] is None
    assert values["skate_weighted_m_s"] == values["skate_height_m_s"] == pytest.approx(2.0, rel=1e-4)
    assert (values["skate_ratio"], values["contact_consistency"]) == (1.0, 1.0)


def test_height_lowers_the_weight_as_published() -> None:
    half = 0.5 * OPTIONS.weighted_height_m
    raised = moved(standing(), lambda t: (0.3 * t, np.where(np.arange(len(t)) < 31, 0.0, half), 0.0))
    expected = 0.3 * (30 * 1.0 + (2.0 - 2.0**0.25) + 29 * (2.0 - np.sqrt(2.0))) / 60
    assert measured(raised)["skate_weighted_m_s"] == pytest.approx(expected, rel=1e-3)
    hovering = moved(standing(), lambda t: (0.3 * t, 1.0, 0.0))
    assert measured(hovering)["skate_height_m_s"] == pytest.approx(0.3, rel=1e-4), "heights count from planted feet"
    over = measured(hovering, floor="zero")
    assert (over["skate_weighted_m_s"], over["skate_height_m_s"], over["near_floor_share"]) == (0.0, None, 0.0)


def test_the_jerk_of_a_sinusoid_is_that_of_its_third_derivative() -> None:
    size, frequency, rate = 0.1, 1.0, 60.0
    swinging = moved(standing(181, rate), lambda t: (0.0, size * np.sin(2 * np.pi * frequency * t), 0.0))
    values = measured(swinging, rate_hz=rate)
    peak = size * (2 * np.pi * frequency) ** 3
    assert values["jerk_peak_m_s3"] == pytest.approx(peak, rel=0.01)
    assert values["jitter_m_s3"] == pytest.approx(2.0 / np.pi * peak, rel=0.02)


def test_penetration_is_the_depth_of_the_lowest_point() -> None:
    values = measured(moved(standing(), lambda t: (0.0, np.where(t < 1.0, -0.04, 0.0), 0.0)))
    assert values["penetration_max_m"] == pytest.approx(0.04, abs=1e-6)
    assert values["penetration_m"] == pytest.approx(0.04 * 30 / 61, abs=1e-6)


@pytest.mark.parametrize(
    ("joint", "axis", "bend", "excess"),
    [
        ("LeftLeg", (1.0, 0.0, 0.0), 150.0, 15.0),
        ("RightLeg", (1.0, 0.0, 0.0), -25.0, 15.0),
        ("RightLeg", (1.0, 0.0, 0.0), 130.0, 0.0),
        ("LeftForeArm", (0.0, 1.0, 0.0), 160.0, 10.0),
    ],
)
def test_a_hinge_beyond_its_range_exceeds_it_by_the_angle(
    joint: str, axis: tuple[float, float, float], bend: float, excess: float
) -> None:
    values = measured(turned(standing(), joint, axis, bend))
    assert values["limit_excess_deg"] == pytest.approx(excess, abs=1e-3)
    assert values["limit_excess_max_deg"] == pytest.approx(excess, abs=1e-3)


def test_measures_of_feet_equal_loops_of_the_published_formulas() -> None:
    rng = np.random.default_rng(7)
    points = np.cumsum(rng.normal(scale=0.004, size=(80, 4, 3)), axis=0)
    feet = Feet(points, points[..., 1], rng.random((80, 4)) < 0.5, RATE)
    weighted, by_height, by_contact, both = [], [], [], []
    for frame in range(79):
        for point in range(4):
            step = points[frame + 1, point] - points[frame, point]
            speed, height = float(np.sqrt((step**2).sum())) * RATE, points[frame, point, 1]
            if feet.labels[frame, point]:
                by_contact.append(speed)
            if point < 2:
                continue
            middle = 0.5 * (height + points[frame + 1, point, 1])
            level = min(max(middle / 0.025, 0.0), 1.0)
            weighted.append(np.hypot(step[0], step[2]) * RATE * (2.0 - 2.0**level))
            if height < 0.05:
                by_height.append(speed)
            if height < 0.05 and points[frame + 1, point, 1] < 0.05:
                both.append(speed > 0.2)
    assert weighted_skate(feet, OPTIONS) == pytest.approx(np.mean(weighted))
    assert skate_by_height(feet, OPTIONS) == pytest.approx(np.mean(by_height))
    assert skate_by_contact(feet) == pytest.approx(np.mean(by_contact))
    assert skate_ratio(feet, OPTIONS) == pytest.approx(np.mean(both))
    slow = np.linalg.norm(np.gradient(points, axis=0), axis=-1)[1:-1] * RATE < 0.15
    same = (slow & (points[1:-1, :, 1] < 0.1)) == feet.labels[1:-1]
    assert contact_consistency(feet, OPTIONS) == pytest.approx(same.mean(), abs=2 / 80)


def test_frame_rates_hardly_change_skate_and_speed() -> None:
    gait = generate_gait(1.4, 0.0, 6.0, 120.0)
    fast, slow = (measured(gait, rate_hz=rate) for rate in (120.0, 30.0))
    for name in ("skate_weighted_m_s", "skate_height_m_s", "skate_contact_m_s", "near_floor_share", "speed_m_s"):
        assert fast[name] == pytest.approx(slow[name], rel=0.1), name
    assert (fast["jitter_m_s3"] or 0.0) > 1.5 * (slow["jitter_m_s3"] or 0.0), "jitter depends on the rate"


def test_clips_that_cannot_be_measured_say_why() -> None:
    with pytest.raises(MotionError, match="measure all clips with rate_hz 20 or less") as refused:
        measured(standing(rate=20.0))
    assert refused.value.code == "frame-rate-too-low"
    with pytest.raises(MotionError, match="at least 4 are needed"):
        measured(standing(3))
    skeleton = studio_skeleton()
    mapping = map_joints(skeleton)
    axes = guess_axes(skeleton, mapping)
    without = {name: joint for name, joint in mapping.joints.items() if "toe" not in name and "knee" not in name}
    lame = QualityBody.of(skeleton, replace(mapping, joints=without), axes)
    assert "ankles are measured" in lame.notes[0]
    assert {hinge.joint for hinge in lame.hinges} == {"elbow"}
    footless = {name: joint for name, joint in without.items() if "ankle" not in name}
    with pytest.raises(MappingError, match="left_ankle"):
        QualityBody.of(skeleton, replace(mapping, joints=footless), axes)


def test_totals_weigh_by_duration_and_draw_whole_takes() -> None:
    values = {"a": [1.0, 3.0, None, 2.0], "b": [None, None, 5.0, None]}
    drawn = total_over_clips(values, [1.0, 3.0, 10.0, 1.0], ["x", "y", "z", "w"], draws=500, seed=3)
    a, b = drawn.totals["a"], drawn.totals["b"]
    assert a.value == pytest.approx(12.0 / 5.0)
    assert (a.clips, a.takes, a.seconds) == (3, 3, 5.0)
    assert a.low is not None
    assert a.high is not None
    assert 1.0 <= a.low < 2.4 < a.high <= 3.0
    assert (b.value, b.low, b.clips) == (5.0, None, 1)
    rng = np.random.default_rng(0)
    column = rng.normal(size=40).tolist()
    takes = [str(number) for number in range(40)]
    once = total_over_clips({"a": column}, [1.0] * 40, takes, draws=1000, seed=0)
    thrice = total_over_clips({"a": column * 3}, [1.0] * 120, takes * 3, draws=1000, seed=0)
    assert once.totals["a"][:3] == pytest.approx(thrice.totals["a"][:3]), "pieces of a take add no certainty"
    low, high = once.totals["a"][1:3]
    assert low is not None
    assert high is not None
    assert high - low == pytest.approx(2 * 1.96 * np.std(column) / np.sqrt(40), rel=0.15)
    (value, least, most) = changes_from(once, total_over_clips({"a": column}, [1.0] * 40, takes, draws=1000, seed=1))[
        "a"
    ]
    assert least is not None
    assert most is not None
    assert (value, least < 0.0 < most) == (0.0, True)


def read(folder: Path, name: str) -> Clip:
    clip = read_motion((folder / name).read_bytes(), name).clip
    assert clip is not None
    return clip


def gliding(clip: Clip, factor: float = 1.2) -> Clip:
    """Return the clip with the path of its body on the ground scaled, so that planted feet glide."""
    across = [0, 2]
    poses = clip.poses.copy()
    poses[:, across] = poses[0, across] + factor * (poses[:, across] - poses[0, across])
    if clip.translations is None:
        return replace(clip, poses=poses)
    shifts = clip.translations.copy()  # the hips of Bandai Namco's skeletons move below a root that stands
    shifts[:, 0, across] = shifts[0, 0, across] + factor * (shifts[:, 0, across] - shifts[0, 0, across])
    return replace(clip, poses=poses, translations=shifts)


@pytest.mark.parametrize(
    "name",
    [
        "cmu-bvh/cmu_12_01_walk.bvh",
        "cmu-bvh/10_03.bvh",
        "bandai-namco-1/dataset-1_walk_normal_001.bvh",
        "bandai-namco-2/dataset-2_walk-turn-left_normal_001.bvh",
    ],
)
def test_recorded_walks_skate_less_than_the_same_walks_gliding(mocap: Path, name: str) -> None:
    clip = read(mocap, name)
    recorded, glided = measured(clip), measured(gliding(clip))
    for measure in ("skate_weighted_m_s", "skate_height_m_s", "skate_contact_m_s", "skate_ratio"):
        one, other = recorded[measure], glided[measure]
        assert one is not None
        assert other is not None
        assert other > 1.15 * one, measure
    assert (glided["contact_consistency"] or 0.0) < (recorded["contact_consistency"] or 0.0)
    assert recorded["limit_excess_max_deg"] == 0.0


def test_depth_and_bends_are_measured_in_every_frame_of_the_clip() -> None:
    still = standing(121, 120.0)
    poses = still.poses.copy()
    poses[50, 1] -= 0.5  # resampling to 30 Hz leaves this frame out
    values = measure_quality(replace(still, poses=poses), body_of(still.skeleton), OPTIONS).values
    assert values["penetration_max_m"] == pytest.approx(0.5, abs=1e-5)
    assert values["penetration_m"] == pytest.approx(0.5 / 121, abs=1e-5)
    assert values["jerk_peak_m_s3"] == 0.0

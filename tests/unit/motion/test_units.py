"""Unit and axes of a file: inferred from the body, or asked from the user if they remain unclear."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.support.floor_work import FLOOR_WORK, floor_work, with_upright_rest
from tests.support.motion_files import body_asf, bvh

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.errors import AmbiguousUnits, ContradictedOption, FormatError, MotionError
from marey_motion.formats import ImportedMotion, ImportOptions, read_motion, write_bvh
from marey_motion.formats.npz import write_npz
from marey_motion.gait import game_skeleton, generate_gait
from marey_motion.importing.units import unit_in_metres
from marey_motion.kinematics import global_positions, global_rotations
from marey_motion.rigs import map_joints
from marey_motion.skeleton import EndSite, Skeleton
from marey_schemas.formats import UNITS_M

# Rows are the walker's x, y, z in the axes of a file whose upward axis is the key.
FILE_AXES: dict[str, np.ndarray] = {
    "y": np.eye(3),
    "z": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "x": np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "-y": np.diag([1, -1, -1]),
    "-z": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-x": np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}
MIRROR = np.diag([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def walk() -> Clip:
    return generate_gait(1.3, 0.2, 2.0, 30.0)


def in_axes(clip: Clip, axes: np.ndarray) -> Clip:
    """Return the same motion in other axes, which may be mirrored."""
    skeleton, sense = clip.skeleton, round(np.linalg.det(axes))
    turned = Skeleton(
        skeleton.joint_names,
        skeleton.parents,
        skeleton.offsets @ axes.T,
        skeleton.rest_rotations,
        tuple(EndSite(site.joint, axes @ site.offset) for site in skeleton.end_sites),
    )
    rotations = clip.rotations.copy()
    rotations[..., 1:] = sense * rotations[..., 1:] @ axes.T
    poses = np.concatenate([clip.root_translations @ axes.T, rotations.reshape(clip.frame_count, -1)], axis=1)
    return Clip(turned, clip.frame_rate_hz, poses.astype(np.float32))


def imported(clip: Clip, unit: str | float = "cm", **options: Any) -> ImportedMotion:
    return read_motion(write_bvh(clip, unit=unit), "walk.bvh", options=ImportOptions(**options))


def codes(motion: ImportedMotion) -> set[str]:
    return {warning.code for warning in motion.warnings}


@pytest.mark.parametrize("unit", UNITS_M)
def test_a_walkers_legs_tell_the_unit(walk: Clip, unit: str) -> None:
    motion = imported(walk, unit)
    assert motion.source.unit_scale_m == pytest.approx(UNITS_M[unit])
    assert motion.clip is not None
    np.testing.assert_allclose(global_positions(motion.clip), global_positions(walk), atol=2e-4)
    assert any("legs of" in sentence and "hips" in sentence for sentence in motion.source.evidence)
    assert ("unit-inferred" in codes(motion)) == (unit not in ("m", "cm", "mm"))


@pytest.mark.parametrize("up_axis", FILE_AXES)
def test_a_walker_tells_which_axis_points_up(walk: Clip, up_axis: str) -> None:
    motion = imported(in_axes(walk, FILE_AXES[up_axis]))
    assert motion.source.up_axis == up_axis
    assert motion.clip is not None
    np.testing.assert_allclose(global_positions(motion.clip), global_positions(walk), atol=2e-4)
    assert ("up-axis-converted" in codes(motion)) == (up_axis != "y")


def test_a_rest_pose_that_lies_does_not_mislead(walk: Clip) -> None:
    """Some exporters rotate a Z-up rest pose upright by the root's rotation. So the import must use the motion."""
    skeleton = game_skeleton()
    poses = np.zeros((30, 3 + 4 * skeleton.joint_count), np.float32)
    poses[:, 3:] = skeleton.rest_rotations.reshape(-1)
    poses[:, :3] = skeleton.offsets[0]
    motion = read_motion(write_bvh(Clip(skeleton, 30.0, poses)), "stand.bvh")
    assert motion.source.up_axis == "y"


def test_someone_lying_is_not_stood_up_silently(walk: Clip) -> None:
    lying = in_axes(walk, FILE_AXES["z"])
    upright_rest = Clip(walk.skeleton, 30.0, _fallen(walk))
    assert imported(lying).source.up_axis == "z"
    with pytest.raises(AmbiguousUnits, match="--up-axis") as refused:
        imported(upright_rest)
    assert refused.value.code == "up-axis-ambiguous"
    assert imported(upright_rest, up_axis="y").source.up_axis == "y"


def on_one_line(clip: Clip) -> Clip:
    """Return the same motion of a skeleton whose bones all point along x at rest, as some exporters write it."""
    skeleton = clip.skeleton
    line = np.array([1.0, 0.0, 0.0])
    bones = np.stack(
        [
            skeleton.offsets[skeleton.children[j][0]] if skeleton.children[j] else line
            for j in range(len(skeleton.parents))
        ]
    )
    bones /= np.linalg.norm(bones, axis=1, keepdims=True)
    rests = quaternions.between_vectors(bones, np.tile(line, (len(bones), 1)))
    offsets = skeleton.offsets.copy()
    offsets[1:] = quaternions.rotate_vectors(rests[skeleton.parents[1:]], skeleton.offsets[1:])
    turned = quaternions.multiply(global_rotations(clip).astype(np.float64), quaternions.conjugate(rests))
    local = turned.copy()
    local[:, 1:] = quaternions.multiply(quaternions.conjugate(turned[:, skeleton.parents[1:]]), turned[:, 1:])
    laid = Skeleton(skeleton.joint_names, skeleton.parents, offsets, skeleton.rest_rotations, ())
    poses = np.concatenate([clip.root_translations, local.reshape(clip.frame_count, -1)], axis=1)
    return Clip(laid, clip.frame_rate_hz, poses.astype(np.float32))


def test_a_rest_pose_on_one_line_tells_no_upward_axis_but_the_motion_does(walk: Clip) -> None:
    laid = on_one_line(walk)
    assert imported(laid).source.up_axis == "y"
    poses = np.zeros((1, laid.poses.shape[1]), np.float32)
    poses[:, 3::4] = 1.0
    resting = Clip(laid.skeleton, 30.0, poses)
    for data in (write_bvh(resting), write_bvh(resting).replace(b"Frames: 1", b"Frames: 0").rpartition(b"\n0.0")[0]):
        with pytest.raises(AmbiguousUnits, match=r"--up-axis.* y or z") as refused:
            read_motion(data, "rest.bvh")
        assert refused.value.code == "up-axis-ambiguous"


def _fallen(walk: Clip) -> np.ndarray:
    """Return poses of a body that lies still along z, three metres above the ground."""
    poses = np.repeat(walk.poses[:1], 20, axis=0)
    poses[:, :3] = [0.0, 3.0, 5.0]
    poses[:, 3:7] = [np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]
    return poses


def on_all_fours(facing: float) -> Clip:
    """Return a clip of a body that crawls three metres along z on hands and feet, towards +z or −z."""
    places = {
        "Hips": (None, (0, 0.6, 0)),
        "Spine": ("Hips", (0, 0.6, 0.4)),
        "Neck": ("Spine", (0, 0.65, 0.9)),
        "Head": ("Neck", (0, 0.7, 1.2)),
        **{
            f"{side}{name}": (parent and side + parent if parent not in ("Hips", "Spine") else parent, (x * sign, y, z))
            for side, sign in (("Left", 1), ("Right", -1))
            for name, parent, (x, y, z) in (
                ("UpLeg", "Hips", (0.1, 0.6, 0)),
                ("Leg", "UpLeg", (0.1, 0.35, 0.3)),
                ("Foot", "Leg", (0.1, 0.05, 0)),
                ("Arm", "Spine", (0.2, 0.6, 0.7)),
                ("ForeArm", "Arm", (0.2, 0.3, 0.7)),
                ("Hand", "ForeArm", (0.2, 0.05, 0.7)),
            )
        },
    }
    names = list(places)
    points = np.array([point for _, point in places.values()]) * [facing, 1.0, facing]
    parents = np.array([-1 if parent is None else names.index(parent) for parent, _ in places.values()], np.int32)
    offsets = points - np.where(parents[:, None] >= 0, points[parents], 0.0)
    rests = np.tile([1.0, 0.0, 0.0, 0.0], (len(names), 1))
    poses = np.tile(np.concatenate([points[0], rests.ravel()]), (30, 1))
    poses[:, 0] += 0.3 * np.sin(np.linspace(0.0, 6.0, 30))
    poses[:, 2] += facing * np.linspace(0.0, 3.0, 30)
    return Clip(Skeleton(tuple(names), parents, offsets, rests, ()), 30.0, poses.astype(np.float32))


@pytest.mark.parametrize("facing", [1.0, -1.0])
@pytest.mark.parametrize("up_axis", ["y", "z"])
def test_what_stands_on_all_fours_is_not_stood_on_its_feet(up_axis: str, facing: float) -> None:
    motion = imported(in_axes(on_all_fours(facing), FILE_AXES[up_axis]), unit_scale_m=0.01)
    assert motion.source.up_axis == up_axis


def test_a_mirrored_file_is_noticed_and_mirrored_back_on_request(walk: Clip) -> None:
    mirrored = in_axes(walk, MIRROR)
    assert "left-handed" in codes(imported(mirrored))
    motion = imported(mirrored, handedness="left")
    assert motion.source.handedness == "left"
    assert motion.clip is not None
    np.testing.assert_allclose(global_positions(motion.clip), global_positions(walk), atol=2e-4)
    assert "left-handed" not in codes(imported(walk))


@pytest.mark.parametrize("stature_m", [1.5, 1.75, 2.0])
def test_adults_of_every_size_are_recognised(stature_m: float) -> None:
    assert imported(generate_gait(1.0, 0.0, 1.0, 30.0, stature_m=stature_m)).source.unit_scale_m == 0.01


def test_a_child_is_asked_about_with_the_candidates(walk: Clip) -> None:
    child = generate_gait(0.6, 0.0, 1.0, 30.0, stature_m=1.1)
    with pytest.raises(AmbiguousUnits) as refused:
        imported(child)
    assert "--unit" in str(refused.value)
    assert "unit_scale_m" in str(refused.value)
    assert "cm (legs 0.5" in str(refused.value)
    assert refused.value.code == "units-ambiguous"
    assert imported(child, unit_scale_m=0.01).source.unit_scale_m == 0.01


def test_what_has_no_legs_is_asked_about() -> None:
    with pytest.raises(AmbiguousUnits, match="--unit"):
        read_motion(bvh(), "arm.bvh")
    motion = read_motion(bvh(), "arm.bvh", options=ImportOptions(unit_scale_m=0.01))
    assert motion.source.up_axis == "y"
    assert "up-axis-assumed" in codes(motion)


def test_the_users_word_counts_more_than_the_body(walk: Clip) -> None:
    motion = imported(walk, unit_scale_m=0.02, up_axis="z", trust_options=True)
    assert (motion.source.unit_scale_m, motion.source.up_axis) == (0.02, "z")
    assert any("given by the user" in sentence for sentence in motion.source.evidence)


@pytest.mark.parametrize(
    ("options", "metres"),
    [({"unit": "inch"}, 0.0254), ({"unit": "inch", "unit_scale_m": 0.02}, 0.02)],
    ids=["by its name", "by its size, which counts before the name"],
)
def test_a_unit_is_given_by_name_or_by_size(walk: Clip, options: dict[str, Any], metres: float) -> None:
    motion = read_motion(write_bvh(walk), "walk.bvh", options=ImportOptions(**options, trust_options=True))
    assert motion.source.unit_scale_m == metres
    assert any(sentence.startswith(f"unit {metres:g} m: given by the user") for sentence in motion.source.evidence)


def test_a_format_that_fixes_its_unit_is_believed(walk: Clip) -> None:
    assert read_motion(write_npz(walk), "walk.npz").source.unit_scale_m == 1.0


@pytest.mark.parametrize("size", [1.0, 0.6, 0.3], ids=["adult", "child", "infant"])
def test_the_unit_that_a_file_states_counts_for_bodies_of_every_size(size: float) -> None:
    motion = read_motion(body_asf(size, 0.45), "body.asf")
    assert motion.source.unit_scale_m == pytest.approx(UNITS_M["cmu"])
    assert codes(motion) == ({"unit-doubtful"} if size < 0.7 else set())


def test_a_stated_unit_that_fits_no_body_is_replaced_with_a_warning() -> None:
    motion = read_motion(body_asf(5.6, 1.0), "body.asf")  # legs of 95 inches, that is of 95 cm
    assert motion.source.unit_scale_m == 0.01
    (warning,) = motion.warnings
    assert warning.code == "unit-inferred"
    assert "states an impossible unit" in warning.message


@pytest.mark.parametrize(("unit", "metres"), [("cm", 0.01), ("INCH", 0.0254), (0.5, 0.5)])
def test_units_are_named_or_measured(unit: str | float, metres: float) -> None:
    assert unit_in_metres(unit) == metres


@pytest.mark.parametrize("unit", ["parsec", 0.0, -1.0, float("nan")])
def test_what_is_no_unit_is_refused(unit: str | float) -> None:
    with pytest.raises(MotionError):
        unit_in_metres(unit)


@pytest.mark.parametrize(
    "options", [{"unit_scale_m": 0.0}, {"up_axis": "w"}, {"frame_rate_hz": -1.0}, {"handedness": "both"}]
)
def test_impossible_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        ImportOptions(**options)


# -- facts that the user gives and the motion contradicts --


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"unit": "mm"}, r"legs would be 0\.0\d+ m long; with cm, they are 0\.\d+ m long.*--trust-options"),
        ({"unit": "m"}, r"legs would be \d+\.?\d* m long; with cm"),
        ({"up_axis": "x"}, r"points along y \(mean cosine 1\.00\), not along x.*--trust-options"),
        ({"up_axis": "-y"}, "not along -y"),
        ({"frame_rate_hz": 12_000.0}, r"would move at \d+ m/s.*--trust-options"),
    ],
)
def test_a_given_fact_that_the_motion_contradicts_is_refused_unless_it_is_confirmed(
    walk: Clip, options: dict[str, Any], told: str
) -> None:
    file = write_bvh(walk, unit="cm")
    with pytest.raises(ContradictedOption, match=told) as refused:
        read_motion(file, "walk.bvh", options=ImportOptions(**options))
    assert refused.value.code == "option-contradicted"
    confirmed = read_motion(file, "walk.bvh", options=ImportOptions(**options, trust_options=True)).source
    [(name, value)] = options.items()
    assert {"unit": confirmed.unit_scale_m, "up_axis": confirmed.up_axis, "frame_rate_hz": confirmed.frame_rate_hz}[
        name
    ] == (UNITS_M[value] if name == "unit" else value)


def test_weak_evidence_against_a_given_fact_gives_a_warning(walk: Clip) -> None:
    file = write_bvh(walk, unit="cm")

    def warned(**options: Any) -> set[str]:
        return codes(read_motion(file, "walk.bvh", options=ImportOptions(**options)))

    assert "unit-doubtful" in warned(unit_scale_m=0.006)
    assert "frame-rate-doubtful" in warned(frame_rate_hz=1.0)
    assert warned(unit="cm", up_axis="y", frame_rate_hz=60.0) == warned()


def test_an_axis_along_which_an_upright_body_travels_does_not_point_up(walk: Clip) -> None:
    """The motion suffices where neither the rest pose nor the ground shows the axis: both are tilted here."""
    tilt = quaternions.from_axis_angle(np.array([0.0, 0.0, 1.0]), -np.pi / 2)
    clip = in_axes(walk, quaternions.as_matrix(tilt))  # the rest pose points along x
    poses = clip.poses.astype(np.float64)
    poses[:, 3:7] = quaternions.multiply(quaternions.conjugate(tilt), poses[:, 3:7])
    poses[:, :3] = walk.root_translations + 0.3 * np.array([0.0, 1.0, 0.0]) * walk.root_translations[:, 2:]  # uphill
    file = write_bvh(replace(clip, poses=poses.astype(np.float32)), unit="cm")
    with pytest.raises(ContradictedOption, match=r"the up axis z contradicts .* points along y"):
        read_motion(file, "uphill.bvh", options=ImportOptions(up_axis="z"))


def test_a_body_that_lies_does_not_contradict_the_axis_of_its_rest_pose(walk: Clip) -> None:
    turned = quaternions.from_axis_angle(np.array([1.0, 0.0, 0.0]), np.pi / 2).astype(np.float32)
    poses = walk.poses[:30].copy()
    poses[:, :3] = (0.0, 0.2, 0.0)
    poses[:, 3:7] = quaternions.multiply(turned, poses[:, 3:7])
    file = write_bvh(Clip(walk.skeleton, 30.0, poses), unit="cm")
    assert "up-axis-doubtful" not in codes(read_motion(file, "lies.bvh", options=ImportOptions(up_axis="y")))


# -- people on the ground --


@pytest.mark.parametrize("unit", ["cm", "cmu"])
@pytest.mark.parametrize("up_axis", ["y", "z"])
@pytest.mark.parametrize("name", FLOOR_WORK)
def test_a_known_rig_on_the_ground_is_a_person_upright_in_its_rest_pose(name: str, up_axis: str, unit: str) -> None:
    """Neither hands on the ground nor flat ground decide: both mislead in cartwheels, rolls or crawling."""
    for heading_deg in (0.0, 45.0, 90.0, 200.0):
        clip = in_axes(floor_work(name, heading_deg=heading_deg), FILE_AXES[up_axis])
        motion = imported(clip, unit)
        assert motion.source.up_axis == up_axis
        assert motion.source.unit_scale_m == pytest.approx(UNITS_M[unit])
        assert "left-handed" not in codes(motion)


def test_a_rest_pose_that_contradicts_motion_and_ground_is_asked_about() -> None:
    """The body is on the ground of a file with z up, but its rest pose has y up."""
    for name, heading_deg in (("crawl", 0.0), ("crawl", 90.0), ("cartwheels", 0.0), ("cartwheels", 90.0)):
        doubtful = with_upright_rest(floor_work(name, heading_deg=heading_deg))
        with pytest.raises(AmbiguousUnits, match=r"rest pose points along y.*--up-axis"):
            imported(doubtful)
        assert imported(doubtful, up_axis="z").source.up_axis == "z"
    for upright in (floor_work("kneel"), generate_gait(1.3, 0.2, 2.0, 30.0)):
        assert imported(with_upright_rest(upright)).source.up_axis == "z"


@pytest.mark.parametrize("up_axis", ["y", "z"])
def test_motion_and_rest_pose_that_agree_show_the_axis_together(up_axis: str) -> None:
    """The kneeling body leans, so its motion alone is not clear; no joint has a known name."""
    kneeling = floor_work("kneel")
    names = {name: f"bone{index}" for index, name in enumerate(kneeling.skeleton.joint_names)}
    motion = imported(in_axes(renamed(kneeling, names), FILE_AXES[up_axis]), unit="cm")
    assert motion.source.up_axis == up_axis
    assert any("cosine 0.7" in sentence and "with cosine 1.00" in sentence for sentence in motion.source.evidence)


def test_a_mirrored_kneeling_body_is_told_by_its_rest_pose() -> None:
    assert "left-handed" in codes(imported(in_axes(floor_work("kneel"), MIRROR)))


# -- names of early optical systems --

EARLY_NAMES = {
    "Hips": "hip",
    "Spine": "lowback",
    "Spine1": "midback",
    "Spine2": "chest",
    "Neck": "neck",
    "Head": "head",
    **{
        f"{side}{name}": f"{start}{early}"
        for side, word in (("Left", "left"), ("Right", "right"))
        for name, early, start in (
            ("Shoulder", "collar", word),
            ("Arm", "uparm", word),
            ("ForeArm", "lowarm", word),
            ("Hand", "hand", word),
            ("UpLeg", "thigh", word[0]),
            ("Leg", "lowleg", word),
            ("Foot", "foot", word),
            ("ToeBase", "toe", word[0]),
        )
    },
}


def renamed(clip: Clip, names: dict[str, str]) -> Clip:
    skeleton = clip.skeleton
    called = tuple(names.get(name, name.lower()) for name in skeleton.joint_names)
    return replace(
        clip,
        skeleton=Skeleton(called, skeleton.parents, skeleton.offsets, skeleton.rest_rotations, skeleton.end_sites),
    )


def test_early_names_with_small_sides_make_an_inch_known(walk: Clip) -> None:
    motion = imported(renamed(walk, EARLY_NAMES), "inch")
    assert motion.source.unit_scale_m == UNITS_M["inch"]
    joints = map_joints(motion.skeleton).joints
    assert (joints["left_shoulder"], joints["right_knee"], joints["left_hip"]) == ("leftuparm", "rightlowleg", "lthigh")
    assert joints["pelvis"] == "hip"


def test_a_unit_that_fits_only_with_unknown_names_is_named(walk: Clip) -> None:
    unnamed = renamed(walk, {name: f"bone{index}" for index, name in enumerate(walk.skeleton.joint_names)})
    with pytest.raises(AmbiguousUnits, match="fit inch, but the names of the joints are not known"):
        imported(unnamed, "inch")


# -- small facts about a file --


def test_a_rate_of_one_frame_a_second_is_doubted(walk: Clip) -> None:
    motion = imported(replace(walk, frame_rate_hz=1.0))
    assert "frame-rate-doubtful" in codes(motion)


def test_a_missing_line_motion_is_named() -> None:
    with pytest.raises(FormatError, match="the line MOTION is missing before this line") as refused:
        read_motion(bvh().replace(b"MOTION\n", b""), "arm.bvh")
    assert (refused.value.code, refused.value.line) == ("motion-missing", 16)


@pytest.mark.parametrize("path", ["../x", "raw/./x", ".."])
def test_a_folder_is_not_called_like_a_step_in_a_path(path: str) -> None:
    with pytest.raises(ValueError, match=r"must not contain \. or \.\."):
        ImportOptions(collection=path)

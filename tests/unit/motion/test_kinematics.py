"""Forward kinematics, compared with a simple reference and chains computed by hand. Also headings and contacts."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.support.present import present

from marey_motion import kinematics, quaternions
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.kinematics_kernels import BLOCK
from marey_motion.skeleton import EndSite, Skeleton


def reference(clip: Clip) -> tuple[Floats, Floats]:
    """Return positions and rotations, computed for one frame and joint at a time with another library."""
    skeleton = clip.skeleton
    sites = skeleton.end_sites
    positions = np.zeros((clip.frame_count, skeleton.joint_count + len(sites), 3))
    rotations = np.zeros((clip.frame_count, skeleton.joint_count, 4))
    for frame in range(clip.frame_count):
        turns = []
        for joint, parent in enumerate(skeleton.parents):
            local = Rotation.from_quat(clip.rotations[frame, joint].astype(float), scalar_first=True)
            offset = skeleton.offsets[joint].copy()
            if joint in clip.translated_joints:
                offset = present(clip.translations)[frame, clip.translated_joints.index(joint)].astype(float)
            if parent < 0:
                positions[frame, joint] = clip.root_translations[frame]
                turns.append(local)
            else:
                positions[frame, joint] = positions[frame, parent] + turns[parent].apply(offset)
                turns.append(turns[parent] * local)
            rotations[frame, joint] = turns[joint].as_quat(scalar_first=True)
        for number, site in enumerate(sites):
            start = positions[frame, site.joint]
            positions[frame, skeleton.joint_count + number] = start + turns[site.joint].apply(site.offset.copy())
    return positions, rotations


@pytest.mark.every_nth(5)
@pytest.mark.parametrize("frames", [1, BLOCK - 1, BLOCK, BLOCK + 1])
@pytest.mark.parametrize("translated", [(), (3, 9, 21), tuple(range(1, 22))])
def test_positions_and_rotations_agree_with_a_plain_reference(
    body: Skeleton, tumbling: Callable[..., Any], frames: int, translated: tuple[Any, ...]
) -> None:
    clip = tumbling(body, frames, translated)
    positions, rotations = reference(clip)

    np.testing.assert_allclose(kinematics.global_positions(clip), positions[:, :22], atol=2e-5)
    np.testing.assert_allclose(kinematics.global_positions(clip, end_sites=True), positions, atol=2e-5)
    assert np.max(quaternions.angle_between(kinematics.global_rotations(clip), rotations)) < 2e-5


def test_double_precision_poses_give_double_precision_positions(body: Skeleton, tumbling: Callable[..., Any]) -> None:
    clip = tumbling(body)
    positions, _ = reference(clip)
    poses = clip.poses.astype(np.float64)
    rotations = poses[:, 3:].reshape(70, -1, 4)
    rotations /= np.linalg.norm(rotations, axis=2, keepdims=True)

    result = kinematics.forward_kinematics(body, poses)
    assert result.dtype == np.float64
    np.testing.assert_allclose(result, positions[:, :22], atol=1e-13)


def test_a_bent_chain_lies_where_a_pencil_would_draw_it() -> None:
    offsets = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    parents = np.array([-1, 0], np.int32)
    arm = Skeleton(("upper", "fore"), parents, offsets, quaternions.identity(2), (EndSite(1, offsets[1]),))
    up = quaternions.from_axis_angle([0, 0, 1], np.pi / 2)
    poses = np.concatenate(([5.0, 0.0, 0.0], up, up)).astype(np.float32)[None]

    positions = kinematics.global_positions(Clip(arm, 30.0, poses), end_sites=True)
    np.testing.assert_allclose(positions[0], [[5, 0, 0], [5, 1, 0], [4, 1, 0]], atol=1e-6)


def test_a_clip_in_its_rest_pose_stands_where_the_skeleton_rests(body: Skeleton) -> None:
    poses = np.concatenate((body.offsets[0], body.rest_rotations.ravel())).astype(np.float32)[None]
    np.testing.assert_allclose(
        kinematics.global_positions(Clip(body, 30.0, poses))[0], body.rest_global_positions, atol=1e-6
    )


def test_clips_of_one_skeleton_do_not_affect_each_other(body: Skeleton, tumbling: Callable[..., Any]) -> None:
    plain = tumbling(body)
    moved = Clip(body, 30.0, plain.poses, np.ones((plain.frame_count, 2, 3), np.float32), (3, 7))
    alone = [kinematics.global_positions(clip, end_sites=True).tobytes() for clip in (plain, moved)]
    again = [kinematics.global_positions(clip, end_sites=True).tobytes() for clip in (moved, plain)]
    assert again[::-1] == alone
    assert alone[0] != alone[1]
    assert kinematics.global_positions(plain).shape == (plain.frame_count, body.joint_count, 3)
    assert kinematics.forward_kinematics(body, plain.poses.astype(np.float64)).dtype == np.float64


def test_the_same_frames_give_the_same_bytes_wherever_they_stand_in_a_clip(
    body: Skeleton, tumbling: Callable[..., Any]
) -> None:
    clip = tumbling(body, 3 * BLOCK)
    whole = kinematics.global_positions(clip)

    assert kinematics.global_positions(clip.sliced(17, 2 * BLOCK + 5)).tobytes() == whole[17 : 2 * BLOCK + 5].tobytes()


def test_local_rotations_come_back_from_global_ones(body: Skeleton, tumbling: Callable[..., Any]) -> None:
    clip = tumbling(body)
    back = kinematics.as_local_rotations(body, kinematics.global_rotations(clip))
    assert np.max(quaternions.angle_between(back, clip.rotations)) < 1e-5


def test_arrays_that_do_not_fit_the_skeleton_are_refused(body: Skeleton) -> None:
    with pytest.raises(MotionError, match="91"):
        kinematics.forward_kinematics(body, np.zeros((2, 90)))
    with pytest.raises(MotionError, match="22, 4"):
        kinematics.as_global_rotations(body, np.zeros((2, 21, 4)))


def test_a_falling_body_has_its_velocity_in_every_frame() -> None:
    times = np.arange(8) / 60.0
    height = 2.0 - 0.5 * 9.81 * times**2

    np.testing.assert_allclose(kinematics.velocities(height, 60.0), -9.81 * times, atol=1e-9)


def facing(heading: Floats, tilt: float = 0.0) -> Floats:
    """Return the positions of the left and right hip of a body that faces `heading` and leans to its side."""
    left = np.stack((np.cos(heading) * np.cos(tilt), np.full_like(heading, np.sin(tilt)), -np.sin(heading)), axis=1)
    return np.stack((0.1 * left, -0.1 * left), axis=1)


def test_a_body_with_its_left_at_plus_x_faces_plus_z() -> None:
    direction = kinematics.forward_directions(facing(np.zeros(1)), [0], [1])
    np.testing.assert_allclose(direction, [[0.0, 1.0]])


def test_a_left_turn_is_counter_clockwise_from_above_and_positive() -> None:
    heading = np.linspace(0.0, 3 * np.pi, 181)
    measured = kinematics.headings(kinematics.forward_directions(facing(heading), [0], [1]))

    np.testing.assert_allclose(measured, heading, atol=1e-9)
    np.testing.assert_allclose(kinematics.turn_rates(measured, 60.0), np.pi, atol=1e-9)
    quarter = kinematics.forward_directions(facing(np.array([np.pi / 2])), [0], [1])
    np.testing.assert_allclose(quarter, [[1.0, 0.0]], atol=1e-12)


def test_while_lying_on_the_side_the_last_heading_is_kept() -> None:
    positions = facing(np.array([0.5, 0.6, 0.7, 0.8, 0.9]))
    positions[[0, 2, 3]] = [[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]]
    measured = kinematics.headings(kinematics.forward_directions(positions, [0], [1]))

    np.testing.assert_allclose(measured, [0.6, 0.6, 0.6, 0.6, 0.9])


def test_a_heading_that_nothing_defines_is_an_error() -> None:
    lying = np.array([[[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]]])
    for positions, left, right in ((lying, [0], [1]), (lying, [], []), (lying, [0], [0, 1])):
        with pytest.raises(MotionError) as caught:
            kinematics.forward_directions(positions, left, right)
        assert caught.value.code == "heading-undefined"


def test_feet_stand_while_they_are_slow_and_single_frames_do_not_flicker() -> None:
    rate = 60.0
    speed = np.zeros(60)
    speed[20:40] = 1.0
    speed[10] = 1.0  # one bad frame while standing
    travel = np.cumsum(speed) / rate
    toes = np.zeros((60, 2, 3))
    toes[:, 0, 2] = travel

    standing = kinematics.foot_contacts(toes, rate)
    assert standing[:, 1].all()
    expected = np.ones(60, dtype=bool)
    expected[20:39] = False
    assert np.count_nonzero(standing[:, 0] != expected) <= 2
    assert standing[5:15, 0].all()
    assert not standing[24:36, 0].any()


def test_the_ground_is_x_and_z() -> None:
    np.testing.assert_array_equal(kinematics.ground_projection(np.array([[1.0, 2.0, 3.0]])), [[1.0, 3.0]])


def test_positions_of_real_motion_agree_with_the_reference(mocap: Path) -> None:
    from marey_motion.formats import read_motion

    path = mocap / "cmu-bvh" / "01_01.bvh"
    clip = present(read_motion(path.read_bytes(), path.name).clip).sliced(0, 40)
    positions, _ = reference(clip)
    np.testing.assert_allclose(kinematics.global_positions(clip), positions[:, : clip.skeleton.joint_count], atol=1e-5)


def test_importing_the_package_and_its_core_types_loads_no_compiler() -> None:
    code = (
        "import sys, marey_motion, marey_motion.skeleton, marey_motion.clip, marey_motion.errors;"
        "marey_motion.Clip, marey_motion.map_joints, marey_motion.global_positions;"
        "sys.exit(any(name in sys.modules for name in ('numba', 'scipy')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_package_has_no_other_names_than_its_own() -> None:
    import marey_motion

    with pytest.raises(AttributeError, match="nonsense"):
        getattr(marey_motion, "nonsense")  # noqa: B009
    exported = vars(marey_motion)["__all__"]
    assert set(exported) <= set(dir(marey_motion))
    for name in exported:
        home = getattr(marey_motion, name).__module__
        assert home.startswith(("marey_motion.", "marey_schemas.options.")), name

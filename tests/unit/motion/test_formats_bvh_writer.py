"""BVH writer: this project's reader and another reader must read the same motion from its files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.support.another_loader import positions_by_another_loader

from marey_motion.clip import Clip
from marey_motion.errors import FormatError, MotionError
from marey_motion.exporting import write_clip_file
from marey_motion.formats import read_motion, write_motion
from marey_motion.formats.bvh_writer import format_table, with_folded_positions, write_bvh
from marey_motion.gait import generate_gait
from marey_motion.importing.source import SourceInfo
from marey_motion.kinematics import global_positions
from marey_motion.skeleton import Skeleton, same_hierarchy
from marey_schemas.options.imports import ImportOptions

CENTIMETRES = ImportOptions(unit_scale_m=0.01, up_axis="y")


def loaded_elsewhere(data: bytes, folder: Path) -> np.ndarray:
    path = folder / "written.bvh"
    path.write_bytes(data)
    return positions_by_another_loader(path)


@pytest.mark.parametrize("order", ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"])
def test_another_loader_finds_every_joint_within_a_tenth_of_a_millimetre(
    body: Skeleton, tumbling: Callable[..., Clip], tmp_path: Path, order: str
) -> None:
    clip = tumbling(body, translated=(3, 7))
    loaded = loaded_elsewhere(write_bvh(clip, rotation_order=order), tmp_path)
    assert np.abs(loaded * 0.01 - global_positions(clip)).max() < 1e-4


def test_reading_back_gives_the_same_skeleton_and_motion(body: Skeleton, tumbling: Callable[..., Clip]) -> None:
    clip = tumbling(body, translated=(3, 7))
    back = read_motion(write_motion(clip, "bvh"), "back.bvh", options=CENTIMETRES).clip
    assert back is not None
    assert same_hierarchy(back.skeleton, clip.skeleton, tolerance_m=1e-9)
    assert back.translated_joints == (3, 7)
    assert back.frame_rate_hz == clip.frame_rate_hz
    assert np.abs(global_positions(back) - global_positions(clip)).max() < 1e-5


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("inch", 0.0254), (0.05, 0.05)])
def test_lengths_are_written_in_the_unit_asked_for(
    body: Skeleton, tumbling: Callable[..., Clip], tmp_path: Path, unit: str | float, scale: float
) -> None:
    clip = tumbling(body)
    loaded = loaded_elsewhere(write_bvh(clip, unit=unit), tmp_path)
    assert np.abs(loaded * scale - global_positions(clip)).max() < 1e-4


def test_folded_positions_are_right_for_readers_that_ignore_those_below_the_root(tmp_path: Path) -> None:
    walk = generate_gait(1.2, 0.5, 4.0, 30.0)
    body = walk.skeleton
    still = Skeleton(
        joint_names=("Reference", *body.joint_names),
        parents=np.concatenate(([-1], body.parents + 1)).astype(np.int32),
        offsets=np.concatenate((np.zeros((1, 3)), body.offsets)),
        rest_rotations=np.concatenate(([[1.0, 0, 0, 0]], body.rest_rotations)),
    )
    turned = np.tile(np.array([0.8, 0.0, 0.6, 0.0], np.float32), (walk.frame_count, 1))
    poses = np.concatenate((np.ones((walk.frame_count, 3), np.float32), turned, walk.poses[:, 3:]), axis=1)
    neck = still.index_of("Neck")
    stretch = still.offsets[neck] + np.linspace(-0.002, 0.002, walk.frame_count)[:, None]
    moved = np.stack((walk.root_translations, stretch), axis=1)
    clip = Clip(still, 30.0, poses, moved, (1, neck))
    truth = global_positions(clip)

    def error_m(*, folded: bool) -> np.ndarray:
        path = tmp_path / "written.bvh"
        path.write_bytes(write_clip_file(clip, "bvh", fold_positions=folded).data)
        loaded = positions_by_another_loader(path, only_root=True)
        distances: np.ndarray = np.linalg.norm(loaded * 0.01 - truth, axis=2)
        return distances.max(axis=0)

    assert error_m(folded=False)[1:].min() > 2.0
    below_neck = {joint for joint in range(still.joint_count) if neck in still.path_to_root(joint)}
    folded = error_m(folded=True)
    assert max(folded[joint] for joint in range(1, still.joint_count) if joint not in below_neck) < 1e-4
    assert max(folded[joint] for joint in below_neck) < 0.005
    assert with_folded_positions(walk) is walk


def test_an_unknown_unit_is_refused(body: Skeleton, tumbling: Callable[..., Clip]) -> None:
    with pytest.raises(MotionError, match="furlong"):
        write_bvh(tumbling(body), unit="furlong")


def test_joints_keep_the_rotation_orders_of_their_source(body: Skeleton, tumbling: Callable[..., Clip]) -> None:
    orders = ["XYZ", "YZX"] * 11
    channels = tuple(tuple(f"{axis}rotation" for axis in order) for order in orders)
    info = SourceInfo("bvh", "a.bvh", 0.01, "y", channels=channels)
    clip = tumbling(body)
    written = read_motion(write_bvh(clip, source=info), "b.bvh", options=CENTIMETRES)
    found = ["".join(name[0] for name in names if name.endswith("rotation")) for names in written.source.channels]
    assert found == orders
    assert written.clip is not None
    assert np.abs(global_positions(written.clip) - global_positions(clip)).max() < 1e-5


def test_angles_do_not_jump_where_the_motion_does_not(body: Skeleton) -> None:
    angles = np.radians(np.linspace(0, 720, 200)) / 2
    poses = np.zeros((200, 3 + 4 * body.joint_count), np.float32)
    poses[:, 3::4] = 1.0
    poses[:, 3], poses[:, 5] = np.cos(angles), np.sin(angles)
    data = write_bvh(Clip(body, 60.0, poses))
    rows = np.array([line.split() for line in data.decode().split("Frame Time")[1].splitlines()[1:]], np.float64)
    assert np.abs(np.diff(rows, axis=0)).max() < 4.0


def test_joints_in_another_order_are_written_depth_first(body: Skeleton, tumbling: Callable[..., Clip]) -> None:
    breadth_first = sorted(range(body.joint_count), key=lambda joint: len(body.path_to_root(joint)))
    place = {joint: index for index, joint in enumerate(breadth_first)}
    parents = np.array([place.get(int(body.parents[joint]), -1) for joint in breadth_first], np.int32)
    names = tuple(body.joint_names[joint] for joint in breadth_first)
    shuffled = Skeleton(names, parents, body.offsets[breadth_first], body.rest_rotations)
    clip = tumbling(shuffled, translated=(4, 9))
    back = read_motion(write_bvh(clip), "b.bvh", options=CENTIMETRES).clip
    assert back is not None
    order = [back.skeleton.index_of(name) for name in names]
    assert np.abs(global_positions(back)[:, order] - global_positions(clip)).max() < 1e-5


def test_names_that_would_end_the_joint_are_written_without_that(body: Skeleton, tumbling: Callable[..., Clip]) -> None:
    odd = replace(body, joint_names=("a {b}\n", *body.joint_names[1:]), display_names=())
    back = read_motion(write_bvh(tumbling(odd)), "b.bvh", options=CENTIMETRES)
    assert back.skeleton.joint_names[0] == "a _b__"


def test_the_same_clip_always_gives_the_same_bytes(body: Skeleton, tumbling: Callable[..., Clip]) -> None:
    assert write_bvh(tumbling(body)) == write_bvh(tumbling(body))


@pytest.mark.parametrize("value", [0.0, -0.0, 1e-7, -4e-7, 0.5, -1.25, 123456.654321, 99999999999.5])
def test_numbers_are_written_to_six_decimals(value: float) -> None:
    text = format_table(np.array([[value, -1.0]])).decode()
    assert float(text.split()[0]) == pytest.approx(value, abs=5.1e-7)
    assert text.endswith(" -1.000000\n")


def test_lengths_that_no_loader_could_read_are_refused() -> None:
    with pytest.raises(FormatError, match="is too large to be written"):
        format_table(np.array([[1e13]]))


@pytest.mark.parametrize(
    "source", [None, {"details": {"channels": 5}}, {"details": {"channels": [[1, 2, 3]] * 22}}, {"details": {}}]
)
def test_a_record_of_the_import_that_a_user_has_changed_stops_no_export(
    body: Skeleton, tumbling: Callable[..., Clip], source: object
) -> None:
    clip = tumbling(body)
    assert len(clip.skeleton.joint_names) == 22
    assert write_clip_file(clip, "bvh", info={"source": source}).data == write_bvh(clip)


@pytest.mark.parametrize("file_format", ["bvh", "predecessor"])
@pytest.mark.parametrize("rate_hz", [0.5, 0.99, 2e5])
def test_a_frame_rate_that_no_reader_would_accept_is_not_written(
    body: Skeleton, tumbling: Callable[..., Clip], file_format: str, rate_hz: float
) -> None:
    clip = replace(tumbling(body), frame_rate_hz=rate_hz)
    with pytest.raises(FormatError, match="resample the clip, or write it as npz") as refused:
        write_motion(clip, file_format)
    assert refused.value.code == "frame-rate"


@pytest.mark.parametrize("rate_hz", [1.0, 1e5])
def test_the_lowest_and_the_highest_frame_rate_are_read_back(
    body: Skeleton, tumbling: Callable[..., Clip], rate_hz: float
) -> None:
    clip = replace(tumbling(body), frame_rate_hz=rate_hz)
    read = read_motion(write_bvh(clip), "take.bvh", options=CENTIMETRES).clip
    assert read is not None
    assert read.frame_rate_hz == pytest.approx(rate_hz)

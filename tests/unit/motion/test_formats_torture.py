"""Huge, deeply nested, malicious or broken files are read or refused within seconds and with limited memory."""

from __future__ import annotations

import multiprocessing
import random
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support import motion_big_files as big
from tests.support.motion_files import ARM, ZXY, bvh, nested
from tests.support.motion_fuzz import LONGEST_S, read_broken, seeds
from tests.support.tiers import examples, is_soak

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.formats import ImportOptions, read_motion, write_bvh
from marey_motion.kinematics import global_positions
from marey_motion.skeleton import EndSite, Skeleton

CENTIMETRES = ImportOptions(unit_scale_m=0.01, up_axis="y", trust_options=True)


LOADED = multiprocessing.get_context("forkserver")
LOADED.set_forkserver_preload([big.__name__])  # each file needs a process of its own, but not its own modules
SIZE = (50 if is_soak() else 15) * big.MEGABYTE


@pytest.mark.every_nth(3)
@pytest.mark.parametrize(
    ("make", "outcome"),
    [
        (big.short_lines, f"read {SIZE // 18}"),
        (big.long_numbers, f"read {SIZE // 207}"),
        (big.endless_hierarchy, "format-limit"),
        (big.one_line, "frame-width"),
        (big.rubbish, "not-bvh"),
    ],
)
def test_a_large_file_needs_less_than_seventeen_times_its_size(
    make: Callable[[int], bytes], outcome: str, tmp_path: Path
) -> None:
    child = LOADED.Process(target=big.read_and_measure, args=(make, SIZE, str(tmp_path)))
    child.start()
    child.join(240)
    found, used = (tmp_path / "result").read_text().split("\n")
    assert found == outcome
    assert int(used) < 17 * SIZE


def test_memory_does_not_follow_the_declared_number_of_frames() -> None:
    motion = read_motion(bvh(["0 0 0 0 0 0 0 0 0"], frames=10**15), "take.bvh", options=CENTIMETRES)
    assert motion.clip is not None
    assert motion.clip.frame_count == 1


@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\N{BYTE ORDER MARK}"])
def test_the_way_a_text_is_stored_changes_nothing(ending: str, mark: str) -> None:
    rows = ["1 2 3 10 20 30 40 50 60"] * 3
    plain = read_motion(bvh(rows), "take.bvh", options=CENTIMETRES).clip
    data = (mark + bvh(rows).decode().replace("\n", ending).replace(" ", "\t")).encode()
    other = read_motion(data, "take.bvh", options=CENTIMETRES).clip
    assert plain is not None
    assert other is not None
    np.testing.assert_array_equal(other.poses, plain.poses)


def test_two_thousand_nested_joints_of_one_name_become_a_clip() -> None:
    data = bvh(["1 " * 6000] * 2, hierarchy=nested(["bone"] * 2000, [ZXY] * 2000))
    clip = read_motion(data, "deep.bvh", options=CENTIMETRES).clip
    assert clip is not None
    assert len(set(clip.skeleton.joint_names)) == 2000
    assert np.isfinite(global_positions(clip)).all()


@pytest.mark.parametrize("value", ["1e13", "-1e300"])
def test_lengths_beyond_any_unit_are_refused(value: str) -> None:
    for data in (bvh([f"{value} 0 0 0 0 0 0 0 0"]), bvh(hierarchy=ARM.replace("90", value))):
        with pytest.raises(MotionError, match="units"):
            read_motion(data, "far.bvh", options=CENTIMETRES)


@pytest.fixture(scope="module")
def readers() -> None:
    """Compile the kernels of each reader in advance, which takes longer than the time limit of a file."""
    for name, data, companion in seeds():
        read_motion(data, name, companion=companion, options=CENTIMETRES)


@pytest.mark.usefixtures("readers")
@settings(max_examples=examples(150, soak=400))
@given(choice=st.integers(0, len(seeds()) - 1), source=st.randoms(use_true_random=False))
def test_broken_files_are_read_or_refused_and_nothing_else(choice: int, source: random.Random) -> None:
    started_s = time.process_time()
    assert read_broken(seeds()[choice], source)
    assert time.process_time() - started_s < LONGEST_S, "of processor time: on a busy machine the clock says nothing"


@st.composite
def clips(draw: st.DrawFn) -> Clip:
    """Draw a clip of a random tree of up to twelve joints with any names, which move at random.

    Some of the joints are translated.
    """
    count = draw(st.integers(1, 12))
    parents = [-1, *(draw(st.integers(0, joint - 1)) for joint in range(1, count))]
    names = draw(
        st.lists(st.text(st.characters(categories=["L", "N"]), min_size=1), min_size=count, max_size=count, unique=True)
    )
    numbers = np.random.default_rng(draw(st.integers(0, 2**32)))
    frames = draw(st.integers(1, 5))
    sites = tuple(EndSite(joint, numbers.normal(size=3)) for joint in range(count) if draw(st.booleans()))
    skeleton = Skeleton(
        tuple(names), np.array(parents, np.int32), numbers.normal(size=(count, 3)), quaternions.identity(count), sites
    )
    rotations = quaternions.normalise(numbers.normal(size=(frames, count, 4))).reshape(frames, -1)
    poses = np.concatenate([numbers.normal(size=(frames, 3)), rotations], axis=1).astype(np.float32)
    moved = tuple(joint for joint in range(1, count) if draw(st.booleans()))
    translations = numbers.normal(size=(frames, len(moved), 3)).astype(np.float32) if moved else None
    return Clip(skeleton, draw(st.sampled_from([24.0, 30.0, 59.94, 120.0, 77.7])), poses, translations, moved)


@settings(max_examples=examples(50, soak=100))
@given(clips(), st.sampled_from(["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"]))
def test_any_clip_survives_being_written_as_bvh(clip: Clip, order: str) -> None:
    back = read_motion(write_bvh(clip, rotation_order=order), "back.bvh", options=CENTIMETRES).clip
    assert back is not None
    names = [back.skeleton.joint_names.index(name) for name in clip.skeleton.joint_names]
    assert np.abs(global_positions(back)[:, names] - global_positions(clip)).max() < 1e-4
    assert back.frame_rate_hz == pytest.approx(clip.frame_rate_hz, rel=1e-4)

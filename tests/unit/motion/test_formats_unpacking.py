"""Limits of time and memory for odd or large files; files that describe a huge motion are refused."""

from __future__ import annotations

import json
import time
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.support.motion_files import AMC, ASF, POSITIONS, ZXY, bvh, nested

from marey_motion.errors import FormatLimit
from marey_motion.formats import ImportOptions, read_motion, unpacking, write_motion, write_predecessor_skeleton
from marey_motion.formats.amc import read_amc
from marey_motion.formats.asf import _AsfReader, parse_asf
from marey_motion.formats.npz import read_npz, write_npz
from marey_motion.gait import generate_gait

File = tuple[str, bytes, bytes | None]


def of_bvh(joints: int) -> File:
    names = [f"joint{number}" for number in range(joints)]
    hierarchy = nested(names, [f"{POSITIONS} {ZXY}", *[""] * (joints - 1)]).replace("CHANNELS 0 ", "CHANNELS 0")
    return "walk.bvh", bvh(["1 2 3 4 5 6"] * 20, hierarchy=hierarchy), None


def of_amc(bones: int) -> File:
    fixed = "".join(f"begin\n name b{n}\n direction 0 1 0\n length 1\n axis 0 0 0 XYZ\nend\n" for n in range(bones))
    names = " ".join(f"b{number}" for number in range(bones))
    asf = ASF.replace(":hierarchy", f"{fixed}:hierarchy", 1).replace("root thigh", f"root thigh {names}", 1)
    frames = "".join(f"{number}\nroot 1 2 3 4 5 6\nthigh 1 2 3\nshin 4\n" for number in range(1, 21))
    return "walk.amc", f"{AMC.partition('1')[0]}{frames}".encode(), asf.encode()


def of_predecessor(_joints: int) -> File:
    clip = generate_gait(1.2, 0.0, 1.0, 30.0)
    document = json.loads(write_motion(clip, "predecessor", encoding="json"))
    few = {"joint_sequence": document["joint_sequence"][:1], "poses": [row[:7] for row in document["poses"]]}
    return "walk.json", json.dumps(document | few).encode(), write_predecessor_skeleton(clip.skeleton)


@pytest.mark.parametrize("make", [of_bvh, of_amc, of_predecessor])
def test_a_motion_of_joints_that_the_file_says_nothing_of_is_limited(
    make: Callable[[int], File], monkeypatch: pytest.MonkeyPatch
) -> None:
    name, data, companion = make(40)
    options = ImportOptions(unit_scale_m=0.01, up_axis="y")
    assert read_motion(data, name, companion=companion, options=options).clip is not None
    monkeypatch.setattr(unpacking, "MOST_UNPACKED_BYTES", 1 << 13)
    with pytest.raises(FormatLimit, match="most joints have no channels"):
        read_motion(data, name, companion=companion, options=options)


def test_a_motion_whose_numbers_are_all_in_the_file_may_be_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unpacking, "MOST_UNPACKED_BYTES", 1)
    assert read_motion(write_motion(generate_gait(1.2, 0.0, 1.0, 30.0), "bvh"), "walk.bvh").clip is not None


def test_an_amc_needs_little_more_memory_than_its_rotations() -> None:
    name, data, companion = of_amc(400)
    header, _, rest = data.decode().partition("1\n")
    frame = rest.partition("\n2\n")[0]
    long = (header + "".join(f"{number}\n{frame}\n" for number in range(1, 1001))).encode()
    read_amc(data, name, companion=companion)  # compiles the kernels, and parses the ASF
    tracemalloc.start()
    try:
        rotations = read_amc(long, name, companion=companion).rotations
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert rotations is not None
    assert rotations.shape == (1000, 404, 4)
    assert peak_bytes < 4 * rotations.nbytes


def test_an_npz_needs_little_more_memory_than_its_arrays() -> None:
    data = write_npz(generate_gait(1.2, 0.0, 60.0, 120.0))
    read_npz(data, "walk.npz")
    tracemalloc.start()
    try:
        rotations = read_npz(data, "walk.npz").rotations
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert rotations is not None
    assert peak_bytes < 3 * rotations.nbytes


def test_the_lines_of_an_amc_may_have_any_order() -> None:
    bones = 4000
    moving = "".join(f"begin\n name b{n}\n direction 0 1 0\n length 1\n dof rx\nend\n" for n in range(bones))
    names = " ".join(f"b{number}" for number in range(bones))
    asf = ASF.replace(":hierarchy", f"{moving}:hierarchy", 1).replace("root thigh", f"root thigh {names}", 1).encode()
    lines = ["root 1 2 3 4 5 6", "thigh 1 2 3", "shin 4", *(f"b{number} {number % 90}" for number in range(bones))]
    head = AMC.partition("1")[0]
    seconds, turns = [], []
    for order in (lines, lines, lines[::-1]):  # the first reading compiles the kernels
        text = head + "".join(f"{number}\n" + "\n".join(order) + "\n" for number in range(1, 41))
        before = time.process_time()
        turns.append(read_amc(text.encode(), "walk.amc", companion=asf).rotations)
        seconds.append(time.process_time() - before)
    assert turns[1] is not None
    assert (turns[1] == turns[2]).all()
    assert seconds[2] < 3 * seconds[1]


def test_many_axes_of_one_bone_are_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    computed: list[str] = []
    frame = _AsfReader._frame

    def noted(self: _AsfReader, angles: list[float], order: str) -> NDArray[np.float64]:
        computed.append(order)
        return frame(self, angles, order)

    monkeypatch.setattr(_AsfReader, "_frame", noted)
    line = "    axis 0 0 20 XYZ\n"
    assert line in ASF
    skeleton = parse_asf(ASF.replace(line, "    axis 0 0 30 XYZ\n" * 1000 + line, 1).encode(), "body.asf")
    assert (skeleton.bones[1].frame == parse_asf(ASF.encode(), "body.asf").bones[1].frame).all()
    assert len(computed) < 20

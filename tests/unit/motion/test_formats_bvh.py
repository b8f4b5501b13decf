"""BVH reader, with files as various programs write them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.support.motion_files import ARM, POSITIONS, ZXY, bvh, nested, rows_of
from tests.support.present import present

from marey_motion.errors import FormatError, FormatLimit
from marey_motion.formats import bvh_hierarchy, read_motion
from marey_motion.formats.bvh import read_bvh
from marey_motion.importing.source import SourceMotion
from marey_schemas.lru import LruCache


def read(data: bytes, **options: float) -> SourceMotion:
    return read_bvh(data, "take.bvh", **options)


def codes(source: SourceMotion) -> list[str]:
    return [warning.code for warning in source.warnings]


def rotation(source: SourceMotion, joint: int, frame: int = 0) -> Rotation:
    assert source.rotations is not None
    return Rotation.from_quat(source.rotations[frame, joint], scalar_first=True)


def refusal(data: bytes) -> FormatError:
    with pytest.raises(FormatError) as refused:
        read(data)
    return refused.value


ROW = "1 2 3 10 20 30 40 50 60"


class TestLayout:
    @pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
    def test_any_line_ending_gives_the_same_motion(self, ending: str) -> None:
        data = bvh([ROW, ROW]).replace(b"\n", ending.encode())
        source = read(data)
        assert source.joint_names == ("Hips", "Arm")
        np.testing.assert_array_equal(source.root_positions, [[1, 2, 3]] * 2)

    @pytest.mark.parametrize(
        ("found", "written"),
        [
            ("HIERARCHY", "\N{BYTE ORDER MARK}HIERARCHY"),
            ("  ", "\t"),
            ("  ", ""),
            (" ", "  "),
            ("ROOT Hips\n{", "ROOT Hips {"),
            ("ROOT Hips\n{", "Root Hips{"),
            ("HIERARCHY", "\n\nhierarchy"),
            ("End Site", "End site ArmTip"),
            ("Zrotation", "ZROTATION"),
            ("MOTION", "\nMOTION"),
            ("Frames: ", "Frames:\t"),
            ("Frame Time:", "Frame time :"),
        ],
    )
    def test_layouts_of_exporters_give_the_same_motion(self, found: str, written: str) -> None:
        plain, other = read(bvh([ROW])), read(bvh([ROW]).decode().replace(found, written).encode())
        assert other.joint_names == plain.joint_names
        np.testing.assert_array_equal(other.rotations, plain.rotations)
        np.testing.assert_array_equal(other.end_sites[0][1], [0, 5, 0])

    @pytest.mark.parametrize("padding", [b"\x1a", b"\0" * 100, b"\n\x1a\0\0"])
    def test_what_old_disks_put_after_the_end_is_no_number(self, padding: bytes) -> None:
        source = read(bvh([ROW]) + padding)
        assert len(present(source.rotations)) == 1
        assert codes(source) == []

    def test_joints_without_end_sites_are_leaves(self) -> None:
        source = read(bvh(["0 0 0"], hierarchy=nested(["a", "b"], [ZXY, ""], tip=False)))
        assert source.end_sites == ()

    def test_repeated_and_spaced_names_become_unique_and_are_still_shown(self) -> None:
        names = ["Root", "Left Arm", "Bone", "Bone", "Bone"]
        source = read(bvh(["0 0 0 " * 5], hierarchy=nested(names, [ZXY] * 5)))
        assert source.display_names == tuple(names)
        assert source.joint_names == ("Root", "Left Arm", "Left Arm/Bone", "Bone/Bone", "Bone/Bone#2")

    def test_names_that_are_not_utf8_are_read_as_latin1(self) -> None:
        source = read(bvh().replace(b"Arm", b"\xc9paule"))
        assert source.joint_names[1] == "Épaule"

    def test_two_thousand_nested_joints_are_read(self) -> None:
        names = [f"j{n}" for n in range(2000)]
        source = read(bvh(["0 " * 6000], hierarchy=nested(names, [ZXY] * 2000)))
        assert len(source.joint_names) == 2000
        assert source.parents.tolist() == list(range(-1, 1999))


class TestChannels:
    @pytest.mark.parametrize("order", ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"])
    def test_rotations_are_intrinsic_in_the_order_of_the_channels(self, order: str) -> None:
        channels = " ".join(f"{axis}rotation" for axis in order)
        source = read(bvh(["10 20 30"], hierarchy=nested(["a"], [channels])))
        expected = Rotation.from_euler(order, [10, 20, 30], degrees=True)
        assert (rotation(source, 0).inv() * expected).magnitude() < 1e-6

    def test_every_joint_keeps_its_own_order(self) -> None:
        hierarchy = nested(["a", "b"], ["Xrotation Yrotation Zrotation", "Yrotation Zrotation Xrotation"])
        source = read(bvh(["10 20 30 10 20 30"], hierarchy=hierarchy))
        for joint, order in enumerate(["XYZ", "YZX"]):
            expected = Rotation.from_euler(order, [10, 20, 30], degrees=True)
            assert (rotation(source, joint).inv() * expected).magnitude() < 1e-6

    @pytest.mark.parametrize(
        ("channels", "row", "expected"),
        [
            ("", "", Rotation.identity()),
            ("Yrotation", "40", Rotation.from_euler("Y", 40, degrees=True)),
            ("Yrotation Xrotation", "40 50", Rotation.from_euler("YX", [40, 50], degrees=True)),
            ("Xrotation Yposition Zrotation", "40 7 50", Rotation.from_euler("XZ", [40, 50], degrees=True)),
            (f"{ZXY} {POSITIONS}", "10 20 30 1 2 3", Rotation.from_euler("ZXY", [10, 20, 30], degrees=True)),
        ],
    )
    def test_joints_may_have_any_number_of_channels(self, channels: str, row: str, expected: Rotation) -> None:
        hierarchy = nested(["a", "b", "c"], [ZXY, channels, ZXY])
        source = read(bvh([f"1 2 3 {row} 4 5 6"], hierarchy=hierarchy))
        assert (rotation(source, 1).inv() * expected).magnitude() < 1e-6
        last = Rotation.from_euler("ZXY", [4, 5, 6], degrees=True)
        assert (rotation(source, 2).inv() * last).magnitude() < 1e-6

    def test_position_channels_replace_the_offset_axis_by_axis(self) -> None:
        hierarchy = nested(["a", "b"], ["Zposition Yrotation", "Xposition"])
        source = read(bvh(["5 0 7", "6 0 8"], hierarchy=hierarchy))
        np.testing.assert_array_equal(source.root_positions, [[0, 10, 5], [0, 10, 6]])
        assert source.translated_joints == (1,)
        np.testing.assert_array_equal(source.translations, [[[7, 10, 0]], [[8, 10, 0]]])

    def test_positions_that_repeat_the_offset_are_not_kept(self) -> None:
        source = read(bvh(["0 0 0 0 0 0 0 10 0 1 2 3"], hierarchy=nested(["a", "b"], [f"{POSITIONS} {ZXY}"] * 2)))
        assert source.translations is None

    def test_positions_near_zero_on_long_bones_are_displacements(self) -> None:
        channels = [f"{POSITIONS} {ZXY}"] * 3
        row = "0 0 0 0 0 0 " + "0.5 0 0 0 0 0 " * 2
        source = read(bvh([row], hierarchy=nested(["a", "b", "c"], channels)))
        np.testing.assert_array_equal(source.translations, [[[0.5, 10, 0], [0.5, 10, 0]]])
        assert "position-channels-relative" in codes(source)

    @pytest.mark.parametrize("away", ["0 12 0", "0 8 0"])
    def test_a_joint_that_leaves_its_offset_in_one_frame_is_translated(self, away: str) -> None:
        rows = [f"0 0 0 0 0 0 {position} 1 2 3" for position in ("0 10 0", "0 10 0", away, "0 10 0")]
        source = read(bvh(rows, hierarchy=nested(["a", "b"], [f"{POSITIONS} {ZXY}"] * 2)))
        assert source.translated_joints == (1,)

    def test_positions_that_begin_near_zero_and_grow_are_no_displacements(self) -> None:
        rows = [f"0 0 0 0 0 0 0 {height} 0 1 2 3" for height in (0.5, 9.5)]
        source = read(bvh(rows, hierarchy=nested(["a", "b"], [f"{POSITIONS} {ZXY}"] * 2)))
        assert present(source.translations)[:, 0, 1].tolist() == [0.5, 9.5]
        assert "position-channels-relative" not in codes(source)

    def test_bones_without_offsets_are_taken_from_the_position_channels(self) -> None:
        hierarchy = ARM.replace("OFFSET 0 10 0", "OFFSET 0 0 0").replace(f"3 {ZXY}", f"6 {POSITIONS} {ZXY}")
        rows = [f"0 90 0 0 0 0 1 {height} 2 0 0 0" for height in (10, 10, 10.5)]
        source = read(bvh(rows, hierarchy=hierarchy))
        np.testing.assert_array_equal(source.offsets, [[0, 90, 0], [1, 10, 2]])
        assert present(source.translations)[:, 0, 1].tolist() == [10, 10, 10.5]
        assert codes(source) == ["offsets-from-positions"]

    def test_rotations_do_not_change_sign_between_frames(self) -> None:
        angles = np.linspace(0, 1440, 97)
        source = read(bvh(rows_of([[a, a / 2, -a] for a in angles]), hierarchy=nested(["a"], [ZXY])))
        assert source.rotations is not None
        assert (np.sum(source.rotations[1:] * source.rotations[:-1], axis=2) > 0).all()

    def test_angles_of_many_turns_are_reduced_exactly(self) -> None:
        source = read(bvh(["36000000000090 0 0", "90 0 0"], hierarchy=nested(["a"], [ZXY])))
        assert (rotation(source, 0, 0).inv() * rotation(source, 0, 1)).magnitude() < 1e-6


class TestFrames:
    @pytest.mark.parametrize(("declared", "held"), [(2, 3), (4, 3), (1_000_000, 3), (0, 3)])
    def test_the_data_lines_count_not_the_header(self, declared: int, held: int) -> None:
        source = read(bvh([ROW] * held, frames=declared))
        assert source.rotations is not None
        assert len(source.rotations) == held
        assert [w.values for w in source.warnings] == [{"declared": declared, "found": held}]

    def test_frames_over_several_lines_are_joined(self) -> None:
        source = read(bvh(["1 2 3", "10 20 30 40 50 60"] * 2, frames=2))
        np.testing.assert_array_equal(source.rotations, read(bvh([ROW] * 2)).rotations)
        assert codes(source) == ["frames-wrapped"]

    def test_no_frames_leave_a_skeleton(self) -> None:
        source = read(bvh([]))
        assert source.rotations is None
        assert codes(source) == ["no-frames"]

    @pytest.mark.parametrize(
        ("frame_time", "rate_hz"),
        [
            (".0083333", 120.0),
            ("0.00833333", 120.0),
            ("0.0416667", 24.0),
            ("0.0333333", 30.0),
            ("0.016667", 60.0),
            ("0.0417083750417", 24000 / 1001),
            ("1e-2", 100.0),
            ("0.0372", 1 / 0.0372),
        ],
    )
    def test_frame_times_stand_for_the_known_rate_they_were_rounded_from(self, frame_time: str, rate_hz: float) -> None:
        assert read(bvh(frame_time=frame_time)).frame_rate_hz == rate_hz

    @pytest.mark.parametrize(("frame_time", "rate"), [("0.0333", "30 Hz"), ("0.033", "30 Hz"), ("0.0083", "120 Hz")])
    def test_a_rate_beside_a_known_one_is_kept_and_the_one_that_may_be_meant_is_named(
        self, frame_time: str, rate: str
    ) -> None:
        source = read(bvh(frame_time=frame_time))
        assert source.frame_rate_hz == 1 / float(frame_time)
        (warning,) = source.warnings
        assert warning.code == "frame-rate-unusual"
        assert rate in warning.message
        assert "--fps" in warning.message
        assert codes(read(bvh(frame_time="0.0372"))) == []

    def test_a_rate_given_by_the_user_counts_more_than_the_file(self) -> None:
        for frame_time in ("0", "30"):
            assert read(bvh(frame_time=frame_time), frame_rate_hz=25.0).frame_rate_hz == 25.0

    @pytest.mark.parametrize("name", ["Frame Time", "Frames"])
    def test_a_missing_number_is_not_taken_for_a_colon(self, name: str) -> None:
        data = re.sub(rf"{name}:.*".encode(), f"{name}: ".encode(), bvh())
        assert f"{name}: the number is missing after the colon" in str(refusal(data))

    def test_a_file_without_a_frame_time_is_read_at_the_rate_the_user_gives(self) -> None:
        data = bvh([ROW, "", ROW]).replace(b"Frame Time: 0.01\n", b"\n")
        source = read(data, frame_rate_hz=25.0)
        assert (source.frame_rate_hz, source.declared_frame_time_s) == (25.0, None)
        np.testing.assert_array_equal(source.rotations, read(bvh([ROW, ROW])).rotations)
        assert "--fps" in str(refusal(data))
        assert refusal(data.replace(b"50", b"fifty")).line == 19


class TestRefusals:
    @pytest.mark.parametrize(
        ("data", "line", "joint", "words"),
        [
            (b"", 1, None, "empty"),
            (b"\x00\x01\x02rubbish", 1, None, "HIERARCHY"),
            ("HIERARCHY".encode("utf-16"), 1, None, "UTF-16"),
            ("HIERARCHY".encode("utf-16-le"), 1, None, "UTF-16"),
            ("HIERARCHY".encode("utf-16-be"), 1, None, "UTF-16"),
            (bvh().replace(b"OFFSET 0 10 0", b"OFFSET 0 10"), 8, "Arm", "but 3 are needed"),
            (bvh().replace(b"OFFSET 0 10 0", b"OFFSET 0 1,5 0"), 8, "Arm", "decimal comma"),
            (bvh().replace(b"OFFSET 0 10 0", b"OFFSET 0 nan 0"), 8, "Arm", "not finite"),
            (bvh().replace(b"OFFSET 0 10 0\n", b"\n"), 16, "Arm", "no OFFSET"),
            (bvh().replace(b"CHANNELS 3", b"CHANNELS 4"), 9, "Arm", "lists 3"),
            (
                bvh().replace(b"Zrotation Xrotation Yrotation\n    End", b"Zrotation Zrotation Yrotation\n    End"),
                9,
                "Arm",
                "twice",
            ),
            (bvh().replace(b"CHANNELS 3 Zrotation", b"CHANNELS 3 Zscale"), 9, "Arm", "Zscale"),
            (bvh().replace(b"JOINT Arm", b"BONE Arm"), 6, "Hips", "BONE"),
            (bvh([ROW]).replace(b"MOTION", b"MOTON"), 16, None, "expected MOTION, not 'MOTON'"),
            (bvh().replace(b"JOINT Arm\n  {", b"JOINT Arm\n"), 8, "Arm", "must be followed by {, not"),
            (bvh().replace(b"JOINT Arm\n  {", b"JOINT Arm\n  {\n{"), 8, "Arm", "this { does not follow"),
            (bvh(hierarchy=ARM + ARM.replace("HIERARCHY\n", "")), 16, None, "second ROOT"),
            (ARM.encode(), 15, None, "ends"),
            (ARM.encode()[:-4], 14, None, "ends"),
            (bvh(frames="many"), 17, None, "whole number"),
            (bvh(frame_time="fast"), 18, None, "not a number"),
            (bvh([ROW, ROW.replace("40", "nan")]), 20, "Arm", "Zrotation: nan"),
            (bvh([ROW, ROW.replace("3", "3,5")]), 20, "Hips", "decimal comma"),
            (bvh([ROW, ROW.replace("50", "1e400")]), 20, "Arm", "too large"),
            (bvh([ROW, ROW + " 70"]), 20, None, "10 values"),
            (bvh([ROW, "1 2 3 4"])[:-1], 20, None, "cut off"),
            (bvh([], frames=5), 19, None, "contains no frames"),
        ],
    )
    def test_what_is_wrong_is_named_with_its_line(self, data: bytes, line: int, joint: str | None, words: str) -> None:
        error = refusal(data)
        assert words in str(error)
        assert (error.file, error.line, error.joint) == ("take.bvh", line, joint)

    @pytest.mark.parametrize("angle", ["1e16", "-1e308"])
    def test_an_angle_without_a_direction_is_refused(self, angle: str) -> None:
        error = refusal(bvh([ROW, ROW.replace("50", angle)]))
        assert re.search(r"^frame 1: an angle of .* has no direction.*repair or cut", str(error).partition(": ")[2])
        assert (error.code, error.joint) == ("value-range", "Arm")

    def test_a_large_position_is_no_angle(self) -> None:
        assert read(bvh([ROW.replace("1 ", "1e16 ", 1)])).root_positions is not None

    @pytest.mark.parametrize("frame_time", ["0", "-0.01", "1e-9", "30", "33.3333"])
    def test_frame_times_that_give_no_rate_name_the_option(self, frame_time: str) -> None:
        assert "--fps" in str(refusal(bvh(frame_time=frame_time)))

    def test_more_joints_than_any_body_has_are_refused_early(self) -> None:
        hierarchy = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\n" + "JOINT b\n{\nOFFSET 0 0 0\n" * 100_000
        with pytest.raises(FormatLimit, match="more than 4096 joints"):
            read(hierarchy.encode())

    @pytest.mark.parametrize("missing", [5, 15, 25, 40, 60, 100, 200])
    def test_a_file_cut_off_anywhere_is_refused_with_a_line(self, missing: int) -> None:
        assert refusal(bvh([ROW])[:-missing]).line is not None


def test_files_of_one_skeleton_read_alike_whether_its_hierarchy_was_read_before_or_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reads = 0
    real = bvh_hierarchy._HierarchyReader.read

    def counting(self: Any) -> Any:
        nonlocal reads
        reads += 1
        return real(self)

    monkeypatch.setattr(bvh_hierarchy._HierarchyReader, "read", counting)
    monkeypatch.setattr(bvh_hierarchy, "_KNOWN", LruCache(max_entries=4))
    files = [bvh([f"{n} 2 3 10 20 30 40 50 60", f"{n} 2 3 10 20 30 40 50 61"], frame_time="0.04") for n in range(2)]
    files.append(files[0].replace(b"\n", b"\r\n"))
    alone = [read_bvh(data, "take.bvh") for data in files]
    assert reads == 2
    monkeypatch.setattr(bvh_hierarchy, "_KNOWN", LruCache(max_entries=4))
    for data, before in zip(reversed(files), reversed(alone), strict=True):
        again = read_bvh(data, "take.bvh")
        assert again.joint_names == before.joint_names
        np.testing.assert_array_equal(again.rotations, before.rotations)
        np.testing.assert_array_equal(again.root_positions, before.root_positions)
    with pytest.raises(FormatError) as refused:
        read_bvh(bvh(["0 0 0 0 0 0 0 0 0", "0 0 x 0 0 0 0 0 0"]), "take.bvh")
    assert refused.value.line == 20


@pytest.mark.timeout(60)
@pytest.mark.parametrize("line", ["Frames" + " " * 300_000 + "1 2", "Frame Time" + " " * 300_000 + "1 2"])
def test_a_long_line_of_the_header_is_refused_soon(line: str) -> None:
    text = bvh().decode()
    word = line.split(" " * 10, 1)[0]
    found = next(one for one in text.splitlines() if one.startswith(word))
    with pytest.raises(FormatError):
        read_motion(text.replace(found, line).encode(), "take.bvh")


@pytest.mark.timeout(60)
def test_a_long_word_that_is_no_number_is_refused_soon() -> None:
    with pytest.raises(FormatError):
        read_motion(bvh().replace(b"OFFSET 0", b"OFFSET " + b"1" * 300_000 + b"x", 1), "take.bvh")

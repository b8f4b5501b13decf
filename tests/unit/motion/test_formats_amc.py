"""ASF/AMC reader, compared with joint positions that tests compute from the definition of the format."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.support.motion_files import AMC, ASF
from tests.support.present import present

from marey_motion.errors import FormatError
from marey_motion.formats import read_motion
from marey_motion.formats.amc import read_amc
from marey_motion.importing.source import SourceMotion
from marey_motion.kinematics import global_positions
from marey_schemas.formats.companions import pair_companions
from marey_schemas.options.imports import ImportOptions


def read(amc: str = AMC, asf: str = ASF, **options: float) -> SourceMotion:
    return read_amc(amc.encode(), "take.amc", companion=asf.encode(), companion_name="body.asf", **options)


def refusal(amc: str = AMC, asf: str = ASF) -> FormatError:
    with pytest.raises(FormatError) as refused:
        read(amc, asf)
    return refused.value


def by_definition(root: list[float], thigh: list[float], shin: float) -> np.ndarray:
    """Return positions of root, thigh, shin, sole and the sole's tip, computed by the definition of the format.

    Each bone rotates by C M C⁻¹ relative to its parent.
    """

    def fixed(order: str, angles: list[float]) -> np.ndarray:
        return Rotation.from_euler(order.lower(), angles, degrees=True).as_matrix()

    turned = fixed("XYZ", root[3:])
    start = np.array(root[:3])
    positions = [start, start]
    bones = (
        (fixed("XYZ", [0, 0, 20]), fixed("XYZ", thigh), np.array([0, -8, 0])),
        (fixed("XYZ", [0, 30, 0]), fixed("X", [shin]), np.array([0, -7, 0])),
        (np.eye(3), np.eye(3), np.array([0, 0, 3])),
    )
    for frame, motion, vector in bones:
        turned = turned @ frame @ motion @ frame.T
        positions.append(positions[-1] + turned @ vector)
    return np.array(positions)


def test_joints_are_where_the_definition_of_the_format_puts_them() -> None:
    options = ImportOptions(unit_scale_m=1.0, up_axis="y")
    clip = read_motion(AMC.encode(), "take.amc", companion=ASF.encode(), options=options).clip
    assert clip is not None
    placed = global_positions(clip)
    expected = by_definition([1, 2, 3, 10, 20, 30], [40, 50, 60], 70)
    np.testing.assert_allclose(placed[0], expected[:4], atol=1e-5)
    np.testing.assert_allclose(placed[1], by_definition([1, 2, 4, 10, 20, 31], [40, 50, 61], 71)[:4], atol=1e-5)


PLACED = ASF.replace("axis XYZ\n  position 0 0 0", "axis ZXY\n  position 5 6 7").replace(
    "orientation 0 0 0", "orientation 25 35 45"
)


def test_position_and_orientation_of_the_root_place_the_whole_motion() -> None:
    options = ImportOptions(unit_scale_m=1.0, up_axis="y")
    clip = read_motion(AMC.encode(), "take.amc", companion=PLACED.encode(), options=options).clip
    assert clip is not None
    base = Rotation.from_euler("zxy", [25, 35, 45], degrees=True).as_matrix()
    moved = by_definition([1, 2, 3, 10, 20, 30], [40, 50, 60], 70)[:4]
    np.testing.assert_allclose(global_positions(clip)[0], [5, 6, 7] + moved @ base.T, atol=1e-5)


def test_a_quarter_turn_of_the_root_stands_a_body_up_that_moves_along_z() -> None:
    turned = ASF.replace("orientation 0 0 0", "orientation -90 0 0")
    still = AMC.replace("10 20 30", "0 0 0").replace("40 50 60", "0 0 0").replace("shin 70", "shin 0")
    source = read(still, turned)
    np.testing.assert_allclose(present(source.root_positions)[0], [1, 3, -2], atol=1e-12)
    np.testing.assert_allclose(present(source.rotations)[0, 0], [0.5**0.5, -(0.5**0.5), 0, 0], atol=1e-7)
    np.testing.assert_allclose(source.skeleton.rest_global_positions[2], [0, 0, 8], atol=1e-12)


def test_position_and_orientation_of_the_root_place_the_rest_pose() -> None:
    rest = read(asf=PLACED).skeleton.rest_global_positions
    base = Rotation.from_euler("zxy", [25, 35, 45], degrees=True).as_matrix()
    bones = np.array([[0, 0, 0], [0, 0, 0], [0, -8, 0], [0, -15, 0]])
    np.testing.assert_allclose(rest, [5, 6, 7] + bones @ base.T, atol=1e-12)


def test_the_last_bone_ends_in_an_end_site() -> None:
    joint, tip = read().end_sites[0]
    assert joint == 3
    np.testing.assert_allclose(tip, [0, 0, 3])


def test_degrees_of_freedom_turn_in_the_order_they_are_listed() -> None:
    other = read(AMC.replace("thigh 40 50 60", "thigh 60 40 50"), ASF.replace("dof rx ry rz", "dof rz rx ry"))
    in_that_order = Rotation.from_euler("zxy", [60, 40, 50], degrees=True)
    frame = Rotation.from_euler("z", 20, degrees=True)
    found = Rotation.from_quat(present(other.rotations)[0, 1], scalar_first=True)
    assert (found.inv() * frame * in_that_order * frame.inv()).magnitude() < 1e-6


def test_the_root_may_list_its_channels_in_any_order() -> None:
    other = read(
        AMC.replace("root 1 2 3 10 20 30", "root 10 20 30 3 2 1").replace("root 1 2 4 10 20 31", "root 10 20 31 4 2 1"),
        ASF.replace("TX TY TZ RX RY RZ", "RX RY RZ TZ TY TX"),
    )
    np.testing.assert_array_equal(other.root_positions, read().root_positions)
    np.testing.assert_array_equal(other.rotations, read().rotations)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8"])
def test_bones_have_the_same_name_in_both_files_in_any_encoding(encoding: str) -> None:
    asf, amc = (text.replace("shin", "tibia_größe").encode(encoding) for text in (ASF, AMC))
    found = read_amc(amc, "take.amc", companion=asf)
    assert found.joint_names == ("root", "thigh", "tibia_größe", "sole")
    np.testing.assert_array_equal(found.rotations, read().rotations)


def test_radians_are_read_as_radians() -> None:
    in_radians = AMC.replace(":DEGREES", ":RADIANS").replace("shin 70", f"shin {float(np.radians(70))!r}")
    found = present(read(in_radians).rotations)[0, 2]
    np.testing.assert_allclose(found, present(read().rotations)[0, 2], atol=1e-6)


def in_radians(text: str, *angles: str) -> str:
    """Return the text with these angles converted to radians; an angle must be the last number of its line."""
    for angle in angles:
        words = [word if word.isalpha() else repr(float(np.radians(float(word)))) for word in angle.split()]
        text = text.replace(f" {angle}\n", f" {' '.join(words)}\n")
    return text


def test_an_amc_that_does_not_say_its_unit_of_angle_has_that_of_its_asf() -> None:
    silent = in_radians(AMC.replace(":DEGREES\n", ""), "10 20 31", "10 20 30", "40 50 60", "40 50 61", "70", "71")
    asf = in_radians(ASF, "0 0 20 XYZ", "0 30 0 XYZ").replace("angle deg", "angle rad")
    np.testing.assert_allclose(present(read(silent, asf).rotations), present(read().rotations), atol=1e-6)
    np.testing.assert_array_equal(read(AMC.replace(":DEGREES\n", "")).rotations, read().rotations)


@pytest.mark.parametrize(
    ("found", "written"),
    [
        ("angle deg", "ANGLE DEG"),
        ("angle deg", "angle Degrees"),
        (":hierarchy\n  begin", ":HIERARCHY\n  BEGIN"),
        ("shin sole\n  end", "shin sole\n  END"),
        ("direction 0 -1 0\n    length 8", "direction 0,-1, 0\n    length (8)"),
        ("axis 0 0 20 XYZ", "axis (0, 0, 20) XYZ"),
        ("dof rx ry rz", "dof rx, ry, rz"),
        ("order TX TY TZ RX RY RZ", "order (TX, TY, TZ, RX, RY, RZ)"),
    ],
)
def test_keywords_and_numbers_of_an_asf_may_be_written_in_several_ways(found: str, written: str) -> None:
    assert found in ASF
    np.testing.assert_array_equal(read(asf=ASF.replace(found, written)).rotations, read().rotations)


def test_windows_line_ends_comments_and_tabs_change_nothing() -> None:
    noisy = (AMC + "# the end\n").replace(" ", "\t").replace("\n", " \r\n")
    np.testing.assert_array_equal(read(noisy, ASF.replace("\n", "\r\n")).rotations, read().rotations)


def test_the_frame_rate_is_assumed_with_a_warning_unless_it_is_given() -> None:
    assert read().frame_rate_hz == 120.0
    assert [warning.code for warning in read().warnings] == ["frame-rate-assumed"]
    assert read(frame_rate_hz=60.0).warnings == []
    told = read(AMC.replace(":DEGREES", ":DEGREES\n:SAMPLES-PER-SECOND 30"))
    assert (told.frame_rate_hz, told.warnings) == (30.0, [])


def test_the_unit_is_the_inverse_inch_of_the_data_base() -> None:
    assert read().unit_scale_m == pytest.approx(0.05644, abs=1e-5)


def test_gaps_in_the_numbers_of_frames_are_told() -> None:
    assert "frame-number-gap" in [warning.code for warning in read(AMC.replace("\n2\n", "\n7\n")).warnings]


@pytest.mark.parametrize(
    ("amc", "line", "joint", "words"),
    [
        (AMC.replace("shin 70", "shin 70 1"), 7, "shin", "2 values for 1"),
        (AMC.replace("shin 70", "shin"), 7, "shin", "0 values for 1"),
        (AMC.replace("shin 70", "shin nan"), 7, "shin", "not finite"),
        (AMC.replace("shin 70", "shin 1e999"), 7, "shin", "too large"),
        (AMC.replace("shin 70", "shin 7,0"), 7, "shin", "decimal comma"),
        (AMC.replace("shin 70", "knee 70"), 7, None, "no bone 'knee'"),
        (AMC.replace("shin 70", "thigh 1 2 3"), 7, "thigh", "two lines in frame"),
        (AMC.replace("shin 70\n", ""), 7, "shin", "no line for the bone 'shin'; add"),
        (AMC[: AMC.index("thigh 40 50 61")], 11, "thigh", "cut off"),
        (AMC[: AMC.index(" 61")] + "\n", 11, "thigh", "cut off"),
        (":FULLY-SPECIFIED\n:DEGREES\n", 2, None, "no frames"),
        ("rubbish", 1, None, "header of an AMC file"),
    ],
)
def test_what_is_wrong_in_an_amc_is_named_with_its_line(amc: str, line: int, joint: str | None, words: str) -> None:
    error = refusal(amc)
    assert words in str(error)
    assert (error.file, error.line, error.joint) == ("take.amc", line, joint)


@pytest.mark.parametrize(
    ("found", "written", "joint", "words"),
    [
        ("direction 0 -1 0\n    length 8", "length 8", "thigh", "no direction"),
        ("direction 0 -1 0\n    length 8", "direction 0 -1\n    length 8", "thigh", "but 3 are needed"),
        ("    length 8\n", "", "thigh", "no length"),
        ("length 8", "length long", "thigh", "not a number"),
        ("axis 0 0 20 XYZ", "axis 0 0 20 XYX", "thigh", "order of axes"),
        ("dof rx ry rz", "dof rx ry rw", "thigh", "RX RY RZ"),
        ("dof rx ry rz", "dof rx ry l", "thigh", "RX RY RZ"),
        ("dof rx ry rz", "dof tx rx", "thigh", "only the root"),
        ("name shin", "name thigh", "thigh", "two bones have this name"),
        ("thigh shin\n", "thigh calf\n", "calf", ":bonedata does not define"),
        ("shin sole\n", "", "sole", "does not connect"),
        ("shin sole\n", "shin sole\n    root shin\n", "shin", "two parents"),
        ("angle deg", "angle gon", None, "deg or rad"),
        (":hierarchy", ":units\n  angle rad\n:hierarchy", None, "move :units before :bonedata"),
        ("length 0.45", "length -1", None, "positive"),
        (":hierarchy", ":nothing", None, ":hierarchy is missing or empty"),
    ],
)
def test_what_is_wrong_in_an_asf_is_named(found: str, written: str, joint: str | None, words: str) -> None:
    error = refusal(asf=ASF.replace(found, written, 1))
    assert words in str(error)
    assert error.file == "body.asf"
    assert error.line is not None
    assert error.joint == joint


def test_an_asf_alone_is_a_skeleton() -> None:
    imported = read_motion(ASF.encode(), "body.asf", options=ImportOptions(up_axis="y"))
    assert imported.clip is None
    assert imported.skeleton.joint_names == ("root", "thigh", "shin", "sole")


def test_an_amc_alone_is_refused_with_the_reason() -> None:
    with pytest.raises(FormatError, match="together with its ASF"):
        read_motion(AMC.encode(), "zeros.amc")


class TestPairing:
    def test_each_amc_finds_the_asf_of_its_subject_in_its_folder(self) -> None:
        names = [
            "a/16/16.asf",
            "a/16/16_01.amc",
            "a/7/07.asf",
            "a/7/07_01-walk.amc",
            "b/1.asf",
            "b/10.asf",
            "b/10_2.amc",
        ]
        found = {pairing.file: pairing.companion for pairing in pair_companions(names)}
        assert found == {"a/16/16_01.amc": "a/16/16.asf", "a/7/07_01-walk.amc": "a/7/07.asf", "b/10_2.amc": "b/10.asf"}

    def test_a_folders_only_asf_serves_any_name(self) -> None:
        assert pair_companions(["x\\body.asf", "x\\take.AMC"])[0].companion == "x\\body.asf"

    def test_without_an_asf_the_reason_is_given(self) -> None:
        alone, unlike = pair_companions(["a/zeros.amc", "b/take.amc", "b/one.asf", "b/two.asf"])
        assert alone.companion is None
        assert "no ASF" in str(alone.reason)
        assert unlike.companion is None
        assert "none of the ASF files" in str(unlike.reason)


def test_frames_may_be_shorter_than_the_names_of_bones_without_channels() -> None:
    fixed = "".join(
        f"  begin\n    id {number}\n    name {'x' * 100}{number}\n    direction 0 -1 0\n    length 1\n"
        "    axis 0 0 0 XYZ\n  end\n"
        for number in range(4, 31)
    )
    names = " ".join(f"{'x' * 100}{number}" for number in range(4, 31))
    asf = ASF.replace(":hierarchy", f"{fixed}:hierarchy", 1)
    asf = asf.replace("  root thigh", f"  root thigh {names}", 1)
    assert asf.count("begin") > ASF.count("begin")
    head, frames = AMC.split("\n1\n", 1)
    one = frames.split("\n2\n", 1)[0]
    text = head + "".join(f"\n{number}\n{one.rstrip()}" for number in range(1, 501)) + "\n"
    rotations = read(text, asf).rotations
    assert rotations is not None
    assert len(rotations) == 500

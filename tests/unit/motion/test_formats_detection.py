"""Detection of the format of a file by its bytes; if these are not sufficient, by its name."""

from __future__ import annotations

import bz2

import pytest
from tests.support.motion_files import AMC, ASF, bvh

from marey_motion.errors import FormatError, UnknownFormat
from marey_motion.formats import detect_format, read_motion, write_motion
from marey_motion.gait import generate_gait
from marey_schemas.formats import MOTION_FORMATS


@pytest.mark.parametrize(
    ("data", "name", "expected"),
    [
        (bvh(), "take.bvh", "bvh"),
        (bvh(), "take.txt", "bvh"),
        (b"\xef\xbb\xbf\r\n" + bvh(), "take", "bvh"),
        (ASF.encode(), "body.asf", "asf"),
        (AMC.encode(), "take.amc", "amc"),
        (AMC.encode(), "take.bvh", "amc"),
        (ASF.encode(), "skeleton", "asf"),
        (b"PK\x03\x04", "take.npz", "npz"),
        (b' {"poses": []}', "take", "predecessor"),
        (bz2.compress(b"x"), "take", "predecessor"),
        (b"\x02\x50" + bytes(510), "take", "c3d"),
        (b"anything", "take.BVH", "bvh"),
        (b"\x02\x50\x00\x00" + bytes(0x5002 - 4), "take.bson", "predecessor"),
        (b"\x1f\x8b\x00\x00" + bytes(0x8B1F - 4), "take.bson", "predecessor"),
    ],
)
def test_bytes_count_more_than_names(data: bytes, name: str, expected: str) -> None:
    assert detect_format(data, name).name == expected


@pytest.mark.parametrize(
    ("data", "name", "code"),
    [
        (b"", "take.bvh", "file-empty"),
        (b"\r\n \t", "take.bvh", "file-empty"),
        (b"\x1f\x8b\x08", "take.bvh.gz", "format-archive"),
        (b"PK\x03\x04", "takes.zip", "format-archive"),
        (b"PK\x03\x04", "take.bvh", "format-archive"),
        (b"rubbish", "take.xyz", "format-unknown"),
    ],
)
def test_what_no_reader_knows_is_refused_with_a_reason(data: bytes, name: str, code: str) -> None:
    with pytest.raises(UnknownFormat) as refused:
        detect_format(data, name)
    assert (refused.value.code, refused.value.file) == (code, name)


def test_the_endings_that_an_unknown_file_could_have_are_those_that_have_a_reader() -> None:
    with pytest.raises(UnknownFormat, match=r"\.bvh") as refused:
        detect_format(b"rubbish", "take.xyz")
    assert ".c3d" not in str(refused.value)


@pytest.mark.parametrize(
    ("data", "name", "kind"),
    [
        (b"Kaydara FBX Binary  \0\x1a\0", "take.fbx", "FBX"),
        (b"; FBX 7.4.0 project file", "take.fbx", "FBX"),
        (b"Kaydara FBX Binary  \0\x1a\0", "take.bvh", "FBX"),
        (b"glTF\x02\0\0\0", "take.glb", "glTF"),
        (b"PathFileType\t4\t(X/Y/Z)", "take.trc", "TRC"),
        (b"\x93NUMPY\x01\0", "poses.npy", "numpy"),
    ],
)
def test_files_of_other_programs_are_named_with_what_to_do(data: bytes, name: str, kind: str) -> None:
    with pytest.raises(UnknownFormat, match=f"{kind}.*BVH") as refused:
        detect_format(data, name)
    assert refused.value.code == "reader-absent"


def test_marker_files_are_refused_as_what_they_are() -> None:
    with pytest.raises(FormatError, match="C3D") as refused:
        read_motion(b"\x02\x50" + bytes(510), "take.c3d")
    assert refused.value.code == "reader-absent"


def test_an_unknown_format_to_write_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownFormat, match=", ".join(MOTION_FORMATS)):
        write_motion(generate_gait(1.0, 0.0, 0.5), "fbx")

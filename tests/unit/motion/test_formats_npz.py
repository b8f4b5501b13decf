"""The npz format: exact, deterministic, and safe against malicious archives."""

from __future__ import annotations

import io
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.errors import FormatError, FormatLimit
from marey_motion.formats import npz, read_motion, write_motion, write_npz
from marey_motion.skeleton import Skeleton, same_hierarchy


@pytest.fixture
def archive(body: Skeleton, tumbling: Callable[..., Clip]) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(write_npz(tumbling(body, translated=(3, 7))))) as members:
        return {name: members.read(name) for name in members.namelist()}


def unrolled(clip: Clip) -> Clip:
    """Return the clip with the signs of its quaternions made continuous in time."""
    rotations = quaternions.unroll(clip.rotations).reshape(clip.frame_count, -1)
    return replace(clip, poses=np.concatenate([clip.root_translations, rotations], axis=1).astype(np.float32))


def packed(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def member(array: object) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(array), allow_pickle=True)
    return buffer.getvalue()


def test_a_clip_comes_back_to_the_bit(body: Skeleton, tumbling: Callable[..., Clip]) -> None:
    clip = unrolled(tumbling(body, translated=(3, 7)))
    back = read_motion(write_motion(clip, "npz"), "take.npz").clip
    assert back is not None
    assert back.poses.tobytes() == clip.poses.tobytes()
    assert back.translations is not None
    assert clip.translations is not None
    assert back.translations.tobytes() == clip.translations.tobytes()
    assert back.translated_joints == clip.translated_joints
    assert back.frame_rate_hz == clip.frame_rate_hz
    assert same_hierarchy(back.skeleton, clip.skeleton)


def test_a_skeleton_alone_comes_back(body: Skeleton) -> None:
    imported = read_motion(write_npz(body), "body.npz")
    assert imported.clip is None
    assert same_hierarchy(imported.skeleton, body)


def test_the_same_clip_always_gives_the_same_bytes(body: Skeleton, tumbling: Callable[..., Clip]) -> None:
    assert write_npz(tumbling(body)) == write_npz(tumbling(body))


def test_numpy_reads_the_arrays_without_pickles(body: Skeleton, tumbling: Callable[..., Clip]) -> None:
    clip = tumbling(body)
    with np.load(io.BytesIO(write_npz(clip)), allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["poses"], clip.poses)


def test_a_compressed_archive_of_the_same_arrays_is_read(archive: dict[str, bytes]) -> None:
    assert read_motion(packed(archive, zipfile.ZIP_DEFLATED), "take.npz").clip is not None


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("format", member("other"), "must contain the text"),
        ("parents", None, "'parents'"),
        ("offsets", member(np.zeros((3, 3))), "shape (22, 3)"),
        ("offsets", member(np.full((22, 3), np.nan)), "not finite"),
        ("parents", member(np.zeros(22)), "integers"),
        ("parents", member(np.full(22, 40, np.int32)), "root"),
        ("poses", member(np.zeros((70, 91), np.float32)), "not a rotation"),
        ("poses", member(np.zeros((70, 90), np.float32)), "shape (70, 91)"),
        ("frame_rate_hz", member(-1.0), "from 1e-06"),
        ("joint_names", member(np.array([object()], object)), "damaged"),
        ("joint_names", member(np.array(["a"] * 22)), "unique"),
        ("joint_names", member("a"), "text in the shape (1,)"),
        ("joint_names", member(np.arange(22)), "text in the shape (22,)"),
        ("display_names", member("a"), "text in the shape (22,)"),
        ("display_names", member(np.array([], str)), "text in the shape (22,)"),
        ("frame_rate_hz", member(2e5), "to 100000 Hz"),
        ("frame_rate_hz", member(1e-310), "from 1e-06"),
        ("translated_joints", member(np.array([7, 3], np.int32)), "increasing"),
        ("translated_joints", member(np.array([3, 1 << 30], np.int32)), "from 1 to 21"),
        ("poses", b"\x93NUMPY\x01\x00\xff\xff", "damaged"),
        ("poses", b"", "damaged"),
    ],
)
def test_a_wrong_member_is_named(archive: dict[str, bytes], name: str, content: bytes | None, words: str) -> None:
    archive.pop(f"{name}.npy")
    if content is not None:
        archive[f"{name}.npy"] = content
    with pytest.raises(FormatError) as refused:
        read_motion(packed(archive), "take.npz")
    assert words in str(refused.value)
    assert refused.value.file == "take.npz"


@pytest.mark.parametrize(
    ("members", "words"),
    [
        (("poses", "trans", "betas", "mocap_framerate"), "a skeleton's bones; pose the model"),
        (("positions", "fps"), "the archive has the members positions, fps"),
        ((), "the archive has no members"),
    ],
)
def test_an_archive_of_another_kind_is_told_what_it_is(members: tuple[str, ...], words: str) -> None:
    with pytest.raises(FormatError, match=words) as refused:
        read_motion(packed({f"{name}.npy": member(np.zeros((5, 156))) for name in members}), "walk_poses.npz")
    assert refused.value.code == "not-npz"


def test_a_file_that_is_no_archive_is_refused_with_a_remedy() -> None:
    with pytest.raises(FormatError, match="copy or export the file again") as refused:
        read_motion(b"PK\x03\x04 and then a text", "walk.npz")
    assert refused.value.code == "not-npz"


def test_an_archive_that_unpacks_to_too_much_is_refused_unopened(
    archive: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(npz, "MOST_UNPACKED_BYTES", 1 << 20)
    archive["poses.npy"] = member(np.zeros(1 << 20))
    bomb = packed(archive, zipfile.ZIP_DEFLATED)
    assert len(bomb) < 1 << 16
    with pytest.raises(FormatLimit, match="unpacks to"):
        read_motion(bomb, "bomb.npz")


def test_poses_in_half_precision_are_limited_like_those_in_single_precision(
    archive: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = np.load(io.BytesIO(archive["poses.npy"])).astype(np.float16)
    archive["poses.npy"] = member(poses)
    assert read_motion(packed(archive), "take.npz").clip is not None
    monkeypatch.setattr(npz, "MOST_UNPACKED_BYTES", poses.nbytes * 2 - 1)
    assert sum(map(len, archive.values())) < poses.nbytes * 2
    with pytest.raises(FormatLimit, match="the poses need"):
        read_motion(packed(archive), "take.npz")


def test_no_more_is_unpacked_than_the_archive_declares(archive: dict[str, bytes]) -> None:
    """The archive declares a false size: 100 bytes for a member of 64 MiB."""
    archive["format.npy"] = bytes(64 << 20)
    data = bytearray(packed(archive, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(io.BytesIO(data)) as members:
        declared = members.getinfo("format.npy").file_size.to_bytes(4, "little")
    directory = data.rindex(b"format.npy") - 46
    assert data[directory + 24 : directory + 28] == declared
    data[directory + 24 : directory + 28] = (100).to_bytes(4, "little")
    tracemalloc.start()
    try:
        with pytest.raises(FormatError, match="damaged"):
            read_motion(bytes(data), "bomb.npz")
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_methods_that_unpack_without_bounds_are_refused(archive: dict[str, bytes], method: int) -> None:
    with pytest.raises(FormatError, match=r"numpy\.savez_compressed"):
        read_motion(packed(archive, method), "take.npz")


def test_an_archive_without_frames_is_a_skeleton(archive: dict[str, bytes]) -> None:
    archive["poses.npy"] = member(np.zeros((0, 91), np.float32))
    imported = read_motion(packed(archive), "take.npz")
    assert imported.clip is None
    assert [warning.code for warning in imported.warnings] == ["no-frames"]


def test_names_may_be_bytes(archive: dict[str, bytes], body: Skeleton) -> None:
    for name in ("joint_names", "display_names"):
        archive[f"{name}.npy"] = member(np.array([one.encode() for one in body.joint_names]))
    assert read_motion(packed(archive), "take.npz").skeleton.joint_names == body.joint_names


def test_a_header_that_announces_more_than_there_is_is_refused(archive: dict[str, bytes]) -> None:
    archive["poses.npy"] = archive["poses.npy"].replace(b"(70, 91)", b"(7000000, 91)", 1)
    with pytest.raises(FormatError, match="declares"):
        read_motion(packed(archive), "take.npz")


@pytest.mark.parametrize("cut", [10, 100, 1000, 5000])
def test_a_cut_off_archive_is_refused(archive: dict[str, bytes], cut: int) -> None:
    with pytest.raises(FormatError):
        read_motion(packed(archive)[:-cut], "take.npz")

"""Which format a file is in: what its bytes say, and its name where they say nothing."""

from __future__ import annotations

from pathlib import PurePosixPath

from marey_motion.errors import UnknownFormat
from marey_motion.formats.numeric_text import excerpt

BVH, ASF, AMC, NPZ, C3D, PREDECESSOR = "bvh", "asf", "amc", "npz", "c3d", "predecessor"
_SUFFIXES = {
    ".bvh": BVH,
    ".asf": ASF,
    ".amc": AMC,
    ".npz": NPZ,
    ".c3d": C3D,
    ".json": PREDECESSOR,
    ".bson": PREDECESSOR,
    ".bz2": PREDECESSOR,
    ".skeleton": PREDECESSOR,
}
_ARCHIVES = {
    b"\x1f\x8b": "gzip",
    b"\xfd7zXZ": "xz",
    b"\x28\xb5\x2f\xfd": "zstd",
    b"7z\xbc\xaf": "7z",
    b"Rar!": "rar",
}
# What is often uploaded and read by none of our readers, by how it begins.
_FOREIGN = {
    b"Kaydara FBX": "an FBX file",
    b"; FBX": "an FBX file",
    b"glTF": "a glTF file",
    b"PathFileType": "a TRC file of markers",
    b"\x93NUMPY": "a single numpy array",
}
_ZIP = b"PK\x03\x04"


def detect_format(data: bytes, name: str) -> str:
    """The format of a file; its bytes count more than its name.

    Raises
    ------
    UnknownFormat    for empty files, archives and anything no reader knows
    """
    if not data.strip(b"\0\r\n\t "):
        raise UnknownFormat("the file is empty", code="file-empty", file=name)
    suffix = _SUFFIXES.get(PurePosixPath(name.replace("\\", "/")).suffix.lower())
    archive = next((kind for mark, kind in _ARCHIVES.items() if data.startswith(mark)), None)
    if data.startswith(_ZIP):
        if suffix == NPZ:
            return NPZ
        archive = "zip"
    if archive:
        raise UnknownFormat(
            f"a {archive} archive; unpack it and import the files inside", code="format-archive", file=name
        )
    foreign = next((kind for mark, kind in _FOREIGN.items() if data.startswith(mark)), None)
    if foreign:
        raise UnknownFormat(
            f"{foreign}, for which there is no reader; export the motion as BVH", code="reader-absent", file=name
        )
    found = _by_content(data) or suffix
    if found is None:
        raise UnknownFormat(
            f"no reader knows this file, which begins with {excerpt(data[:16])!r}; "
            f"known endings are {', '.join(sorted(_SUFFIXES))}",
            file=name,
        )
    return found


def _by_content(data: bytes) -> str | None:
    start = data[:4096].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if start.startswith(b"hierarchy"):
        return BVH
    if start.startswith(b"bzh"):
        return PREDECESSOR
    lines = [line.strip() for line in start.splitlines()]
    keywords = {line.split()[0] for line in lines if line.startswith(b":") and len(line) > 1}
    if keywords & {b":fully-specified", b":degrees", b":radians"}:
        return AMC
    if keywords & {b":version", b":units", b":bonedata"}:
        return ASF
    if len(data) >= 512 and data[1:2] == b"\x50" and 2 <= data[0] < 128:
        return C3D
    return PREDECESSOR if start.startswith(b"{") else None

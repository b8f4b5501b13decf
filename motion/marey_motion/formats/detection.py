"""Detection of a file's format by its content, or by its name if the content is not enough."""

from __future__ import annotations

from marey_motion.errors import UnknownFormat
from marey_motion.formats.numeric_text import excerpt
from marey_schemas.formats import FORMATS, IMPORTED, FileFormat

_START = 4096
_BLANK = b"\0\r\n\t "
_ARCHIVES = {
    b"\x1f\x8b": "gzip",
    b"\xfd7zXZ": "xz",
    b"\x28\xb5\x2f\xfd": "zstd",
    b"7z\xbc\xaf": "7z",
    b"Rar!": "rar",
}
# Files that are often uploaded and that no reader understands, by how they begin.
_FOREIGN = {
    b"Kaydara FBX": "an FBX file",
    b"; FBX": "an FBX file",
    b"glTF": "a glTF file",
    b"PathFileType": "a TRC file of markers",
    b"\x93NUMPY": "a single numpy array",
}
_ZIP = b"PK\x03\x04"


def detect_format(data: bytes, name: str) -> FileFormat:
    """Find the format of a file; the content of the file has precedence over the name.

    Parameters
    ----------
    data : bytes    content of the file
    name : str    name of the file

    Returns
    -------
    FileFormat    row of the table of formats

    Raises
    ------
    UnknownFormat    if the file is empty, an archive, or of a format that is not in `marey_schemas.formats`
    """
    start = data[:_START]
    if not start.strip(_BLANK) and not data.strip(_BLANK):
        raise UnknownFormat("the file is empty", code="file-empty", file=name)
    named = next((one for one in IMPORTED if one.names(name)), None)
    if named is not None and named.name == "predecessor" and int.from_bytes(data[:4], "little") == len(data):
        return named  # BSON begins with its length, whose bytes may be those with which another format begins
    archive = next((kind for mark, kind in _ARCHIVES.items() if data.startswith(mark)), None)
    if data.startswith(_ZIP):
        if named is not None and name.lower().endswith(named.archives):
            return named
        archive = "zip"
    if archive:
        raise UnknownFormat(
            f"the file is a {archive} archive; unpack it and import the files inside", code="format-archive", file=name
        )
    foreign = next((kind for mark, kind in _FOREIGN.items() if data.startswith(mark)), None)
    if foreign:
        raise UnknownFormat(
            f"the file is {foreign}, which cannot be imported; convert the motion to BVH",
            code="reader-absent",
            file=name,
        )
    found = next((one for one in FORMATS if one.begins is not None and one.begins.search(start)), named)
    if found is None:
        endings = sorted({ending for one in IMPORTED if one.reads for ending in one.endings + one.other_endings})
        raise UnknownFormat(
            f"the format of this file, which begins with {excerpt(data[:16])!r}, is not known; files with "
            f"these endings can be imported: {', '.join(endings)}",
            file=name,
        )
    return found

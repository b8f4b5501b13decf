"""Encodings of the documents of Marey's predecessor: JSON, BSON, or BSON compressed with bz2."""

from __future__ import annotations

import bz2
import json
from typing import Any, Literal

import bson

from marey_motion.errors import FormatError, FormatLimit
from marey_schemas.formats import MOST_UNPACKED_BYTES

Encoding = Literal["json", "bson", "bson.bz2"]
_BZ2_MARK = b"BZh"


def encode_document(document: dict[str, Any], encoding: Encoding) -> bytes:
    """Encode a document of Marey's predecessor as JSON, BSON, or BSON compressed with bz2.

    Parameters
    ----------
    document : dict    the document
    encoding : str    "json", "bson" or "bson.bz2"

    Returns
    -------
    bytes    content of the file
    """
    if encoding == "json":
        return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    blob: bytes = bson.encode(document)
    return bz2.compress(blob) if encoding == "bson.bz2" else blob


def decode_document(data: bytes, file: str) -> dict[str, Any]:
    """Decode a document; nothing larger than `MOST_UNPACKED_BYTES` is unpacked.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages

    Returns
    -------
    dict    the document

    Raises
    ------
    FormatError    if the bytes are in none of the three encodings or contain no document
    """
    document = decode_content(data, file)
    if not isinstance(document, dict):
        raise FormatError(
            "the file contains a list instead of a document with named fields", code="document-damaged", file=file
        )
    return document


def decode_content(data: bytes, file: str) -> dict[str, Any] | list[Any]:
    """Decode a document, or a list in JSON; nothing larger than `MOST_UNPACKED_BYTES` is unpacked.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages

    Returns
    -------
    dict or list    the document or the list

    Raises
    ------
    FormatError    if the bytes are in none of the three encodings, or contain neither a document nor a list
    """
    if data.startswith(_BZ2_MARK):
        data = _decompressed(data, file)
    try:
        if data.lstrip()[:1] in (b"{", b"[") and not _is_bson(data):
            document = json.loads(data.decode("utf-8-sig"))
        else:
            document = bson.decode(data)
    except (ValueError, RecursionError, OverflowError, bson.errors.BSONError) as error:
        if isinstance(error, bson.errors.BSONError) and not str(error):
            raise MemoryError from error  # which bson replaces by an error of its own without a text
        raise FormatError(f"the document cannot be read: {error}", code="document-damaged", file=file) from error
    if not isinstance(document, (dict, list)):
        raise FormatError("the file contains no document", code="document-damaged", file=file)
    return document


def _is_bson(data: bytes) -> bool:
    return len(data) >= 5 and int.from_bytes(data[:4], "little") == len(data) and data[-1] == 0


def _decompressed(data: bytes, file: str) -> bytes:
    decompressor = bz2.BZ2Decompressor()
    try:
        document = decompressor.decompress(data, MOST_UNPACKED_BYTES + 1)
    except (OSError, ValueError, EOFError) as error:
        raise FormatError(f"the bz2 data is damaged: {error}", code="document-damaged", file=file) from error
    if len(document) > MOST_UNPACKED_BYTES:
        raise FormatLimit(f"the document unpacks to more than {MOST_UNPACKED_BYTES} bytes", file=file)
    if not decompressor.eof:
        raise FormatError("the bz2 data is cut off; copy or export the file again", code="file-truncated", file=file)
    return document

"""Large files in pieces: after a lost connection the server is asked how far it got."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from marey_client.errors import Conflict, FileChanged, Unreachable
from marey_client.transport import OCTETS, Transport, as_json, read_model
from marey_schemas.items import Upload, UploadCreate

PIECE_BYTES = 16 << 20
TRIES_PER_PIECE = 5


def send_in_pieces(transport: Transport, path: Path, digest: str) -> str:
    """Send a file as a resumable upload; the digest of the blob it became.

    Raises `Unreachable` where the server stays away, `FileChanged` where the file becomes shorter, `Invalid` where the
    bytes that arrived are not what `digest` says.
    """
    announced = UploadCreate(length=path.stat().st_size, digest=digest)
    upload = read_model(Upload, transport.send("POST", "/uploads", content=as_json(announced)))
    tries = 0
    with path.open("rb") as file:
        while upload.digest is None:
            try:
                upload, tries = _send_piece(transport, upload, file), 0
            except (Unreachable, Conflict):
                tries += 1
                now = transport.get(Upload, f"/uploads/{upload.id}")
                if now == upload and tries == TRIES_PER_PIECE:
                    raise
                upload = now
    return digest


def _send_piece(transport: Transport, upload: Upload, file: BinaryIO) -> Upload:
    """How far the upload is after one more piece; the last one, perhaps empty, makes a blob of it."""
    file.seek(upload.offset)
    piece = file.read(min(PIECE_BYTES, upload.length - upload.offset))
    if not piece and upload.offset < upload.length:
        raise FileChanged(f"{file.name} has become shorter while it was being sent")
    response = transport.send(
        "PATCH",
        f"/uploads/{upload.id}",
        content=piece,
        media_type=OCTETS,
        headers={"Upload-Offset": str(upload.offset)},
        repeatable=False,
    )
    return read_model(Upload, response)

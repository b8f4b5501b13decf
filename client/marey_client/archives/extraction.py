"""Extraction of a version from an archive into files that can be read without a server."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marey_client.downloads import TakenPaths, safe_file_name, saved_atomically
from marey_schemas.encoding.canonical import attach_arrays
from marey_schemas.encoding.codecs import JSON, encode_tree
from marey_schemas.item_files import original_of_clip
from marey_versions.archive.members import MemberKind
from marey_versions.archive.reading import Archive
from marey_versions.records import DatasetEntry, contents_in

ENTRY_SCHEMA = "marey/entry@1"


def extract_archive(archive: Archive, folder: Path) -> Iterator[Path]:
    """Write the newest version of an archive to a folder, and yield the path of each written file.

    Each entry becomes one JSON file with the parts of the entry, and with the revisions to which these parts refer. For
    a clip, the file from which it was imported is written, too. Raises `BadArchive` if the content of a member of the
    archive does not have the digest in the member's name.
    """
    entries = list(archive.versions().entries(archive.manifest.commit))
    extraction = _Extraction(archive, folder, {one.content: one for one in entries}, TakenPaths())
    for place in sorted({_folder_of(folder, one.path) for one in entries}):
        extraction.taken.take(place)
    for entry in entries:
        yield from extraction.write(entry)


@dataclass
class _Extraction:
    """Extraction of the newest version of an archive into a folder, while it runs."""

    archive: Archive
    folder: Path
    entries: Mapping[str, DatasetEntry]
    """Entries of the version by content digest; if several entries have the same content, only one of them."""
    taken: TakenPaths

    def write(self, entry: DatasetEntry) -> Iterator[Path]:
        parts = self._documents(entry.parts)
        tree = {
            "schema": ENTRY_SCHEMA, "path": entry.path, "kind": entry.kind, "tags": list(entry.tags),
            "parts": parts, "revisions": {one: self._revision(one) for one in sorted(set(contents_in(parts)))},
        }  # fmt: skip
        folder, name = _folder_of(self.folder, entry.path), entry.path.rpartition("/")[2]
        yield self._save(folder / safe_file_name(name, f".{entry.kind}.json"), [encode_tree(tree, JSON)])
        original = original_of_clip(safe_file_name(name), parts.get("info"))
        if original is not None:
            ending = Path(safe_file_name(original.name)).suffix
            yield self._save(folder / safe_file_name(name, ending), self.archive.file(original.digest))

    def _revision(self, content: str) -> dict[str, Any]:
        if content in self.entries:
            kind, parts = self.entries[content].kind, self.entries[content].parts
        else:
            found = self.archive.tree(MemberKind.REVISION, content)
            kind, parts = found["kind"], found["parts"]
        return {"kind": kind, "parts": self._documents(parts)}

    def _documents(self, parts: Mapping[str, str]) -> dict[str, Any]:
        return {
            part: attach_arrays(self.archive.tree(MemberKind.DOCUMENT, digest), self.archive.array)
            for part, digest in parts.items()
        }

    def _save(self, path: Path, pieces: Iterable[bytes]) -> Path:
        target = self.taken.take(path)
        with saved_atomically(target) as file:
            for piece in pieces:
                file.write(piece)
        return target


def _folder_of(folder: Path, path: str) -> Path:
    """Return the folder below `folder` that receives the files of the entry at `path`."""
    return folder.joinpath(*(safe_file_name(one) for one in path.split("/")[:-1]))

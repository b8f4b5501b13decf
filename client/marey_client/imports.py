"""Import of folders of motion files: digests are computed in threads, and missing bytes are sent concurrently."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from pydantic import TypeAdapter, ValidationError

from marey_client.arguments import checks_arguments, several
from marey_client.asynchronous.interruption import CallPool
from marey_client.blobs import Blobs
from marey_client.errors import BadFileName, NothingToUpload, SameName
from marey_client.jobs import Jobs
from marey_client.transport import Transport, as_json, read_model
from marey_schemas.encoding.digests import digest_of_file
from marey_schemas.formats import IMPORTED_ENDINGS, LengthUnit
from marey_schemas.formats.companions import pair_companions, stem_of
from marey_schemas.imports import (
    NO_MODEL,
    FileName,
    ImportAnswer,
    ImportEntry,
    ImportFile,
    ImportRequest,
    Refusal,
)
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue.jobs import Job

if TYPE_CHECKING:
    from marey_schemas.datasets.exports import ExportedClip

OTHER_MOTION = (
    ".fbx", ".trc", ".htr", ".mvnx", ".vmd", ".vrma", ".dae", ".glb", ".gltf", ".usd", ".usda", ".usdc",
)  # fmt: skip
"""Endings of files that contain motion in formats that Marey does not read."""
FILES_PER_IMPORT = 50
BYTES_PER_IMPORT = 64 << 20
UPLOADS_AT_ONCE = 8

_FILE_NAME: TypeAdapter[str] = TypeAdapter(FileName)

Notice = Callable[[str, int, int], None]
"""Function called with the stage (`hashing`, `sending`, `importing`), the number of files done, and their total."""


@dataclass(frozen=True)
class LocalFile:
    """File to import. `name` is the path of the file relative to the searched folder in which it was found."""

    name: str
    path: Path
    size_bytes: int


@dataclass(frozen=True)
class FoundFiles:
    """Files in the searched places: the files to import, and the files that are left out."""

    files: tuple[LocalFile, ...]
    left_out: tuple[Path, ...]
    """Files in formats that Marey does not read, hidden motion files, broken links, and skipped folders with motion."""
    exported: Mapping[str, ExportedClip] = field(default_factory=dict)
    """Description of each clip whose file an export of a dataset wrote, by the name of the file."""
    unit: LengthUnit | None = None
    """Unit of length of the files if all of them come from one export; otherwise None."""
    changed_tables: tuple[Path, ...] = ()
    """Tables of take records that differ from the sidecars in their folders; imports use only the sidecars."""

    @property
    def motions_left_out(self) -> tuple[Path, ...]:
        """Left-out files that seem to contain motion, by their endings, and left-out folders with such files."""
        return tuple(path for path in self.left_out if _is_motion(path.name) or path.is_dir())


def find_files(places: str | Path | Iterable[str | Path]) -> FoundFiles:
    """Find the motion files in folders and their subfolders.

    Hidden files and hidden or linked subfolders are left out, but files among `places` are always included. Files in a
    folder that an export of a dataset wrote are named by the paths of their clips. Raises
    `NothingToUpload` if a place does not exist or no motion file is found; `SameName` if two files would get the same
    name; `BadSidecar` if the sidecar of an export is damaged; and `OSError` if a folder cannot be read.
    """
    from marey_client.bridges.returning import ReturningFolder

    searched = [Path(place) for place in several(places)]
    files: dict[str, LocalFile] = {}
    left_out: list[Path] = []
    returning: list[ReturningFolder] = []
    for place in searched:
        if place.is_file():
            _add(files, place.name, place)
            continue
        if not place.is_dir():
            raise NothingToUpload(
                f"{place} does not exist; give the path of a motion file, or of a folder with motion files"
            )
        folder = ReturningFolder.at(place)
        returning += [folder] if folder is not None else []
        visible, hidden = _files_below(place)
        for path in visible:
            below = path.relative_to(place).as_posix()
            if folder is not None and below in folder.own_files:
                continue
            if path.name.lower().endswith(IMPORTED_ENDINGS):
                _add(files, below if folder is None else folder.name_of(below), path)
            else:
                left_out.append(path)
        left_out += hidden
    if not files:
        reasons = "".join(f"; {line}" for line in left_out_texts(left_out))
        raise NothingToUpload(f"no motion files ({', '.join(IMPORTED_ENDINGS)}) in {_listed(searched)}{reasons}")
    return FoundFiles(
        tuple(files.values()),
        tuple(left_out),
        {name: clip for folder in returning for name, clip in folder.clips.items() if name in files},
        unit=returning[0].unit if len(searched) == len(returning) == 1 else None,
        changed_tables=tuple(folder.table for folder in returning if folder.table_changed),
    )


def _files_below(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the files in a folder and its subfolders, sorted, and the paths that are left out, sorted.

    Left out are hidden motion files, broken links to motion files, and hidden or linked folders that contain motion
    files. Files of macOS whose names begin with `._` are ignored.
    """
    found: list[Path] = []
    left_out: list[Path] = []
    for parent, folders, names in os.walk(folder, onerror=_raise):
        apart = [name for name in folders if name.startswith(".") or Path(parent, name).is_symlink()]
        left_out += (Path(parent, name) for name in apart if _has_motion(Path(parent, name)))
        folders[:] = (name for name in folders if name not in apart)
        for name in names:
            path = Path(parent, name)
            if not name.startswith(".") and path.is_file():
                found.append(path)
            elif _is_motion(name) and not name.startswith("._") and (name.startswith(".") or path.is_symlink()):
                left_out.append(path)
    return sorted(found), sorted(left_out)


def _is_motion(name: str) -> bool:
    return name.lower().endswith((*IMPORTED_ENDINGS, *OTHER_MOTION))


def _has_motion(folder: Path) -> bool:
    """Return whether a folder or one of its subfolders contains a file with the ending of a motion file."""
    return any(_is_motion(name) for _, _, names in os.walk(folder) for name in names)


def _raise(error: OSError) -> None:
    raise error


def _add(files: dict[str, LocalFile], name: str, path: Path) -> None:
    known = files.setdefault(name, LocalFile(name, path, path.stat().st_size))
    if not known.path.samefile(path):
        raise SameName(
            f"the files {known.path} and {path} would both get the name {name} on the server; import the "
            "folder that contains both, or import them into different collections"
        )


def batches(files: Sequence[LocalFile]) -> Iterator[list[LocalFile]]:
    """Split files into batches that one request can import.

    A file is in one batch with its companion, such as an AMC with its ASF or a model with its tree. Files whose names
    differ only in the ending are in one batch, too, because names of clips depend on the files of a request.
    """
    by_name = {file.name: file for file in files}
    groups: defaultdict[tuple[str, str], list[LocalFile]] = defaultdict(list)
    for file in files:
        groups[PurePosixPath(file.name).parent.as_posix(), stem_of(file.name)].append(file)
    beside = {pairing.file: pairing.beside for pairing in pair_companions(by_name)}
    companions = {name for names in beside.values() for name in names}
    portion: dict[str, LocalFile] = {}
    size = 0
    for group in groups.values():
        if all(file.name in companions for file in group):
            continue  # travels with the files that need it, never on its own
        needed = [by_name[name] for file in group for name in beside.get(file.name, ())]
        together = {file.name: file for file in [*needed, *group]}
        together_bytes = sum(file.size_bytes for file in together.values())
        if portion and (len(portion) + len(together) > FILES_PER_IMPORT or size + together_bytes > BYTES_PER_IMPORT):
            yield list(portion.values())
            portion, size = {}, 0
        size += sum(file.size_bytes for name, file in together.items() if name not in portion)
        portion |= together
    if portion:
        yield list(portion.values())


@checks_arguments
@dataclass(frozen=True)
class Imports:
    """Imports of motion files into a project: search, upload, import, and restoring of exported clips."""

    transport: Transport
    project: str
    blobs: Blobs
    jobs: Jobs

    def upload(
        self, files: Sequence[LocalFile], options: ImportOptions | None = None, *, notice: Notice | None = None
    ) -> list[ImportEntry]:
        """Import files; return one entry for each file, in order. A refused file does not affect the other files."""
        notify = notice or _ignore_notice
        named = [file for file in files if _can_be_sent(file.name)]
        entries = {file.name: _refused_name(file.name) for file in files if not _can_be_sent(file.name)}
        sent = {file.name: file for file in self.send(named, notice=notify)}
        portions = list(batches(named))
        for portion in portions:
            for entry in self.run(tuple(sent[file.name] for file in portion), options):
                entries.setdefault(entry.name, entry)
            notify("importing", len(entries), len(files))
        if len(portions) > 1:  # a graph may have been sent before the portion with its models
            refused = {name for name, one in entries.items() if one.error and one.error.code == NO_MODEL}
            for portion in batches([file for file in named if file.name in refused]):
                again = self.run(tuple(sent[file.name] for file in portion), options)
                entries |= {entry.name: entry for entry in again}
        return list(entries.values())

    def restore(self, found: FoundFiles, entries: Sequence[ImportEntry], *, notice: Notice | None = None) -> int:
        """Give imported clips the take records and tags that they had when they were exported.

        `entries` are the results of the import of `found`. A value that a clip has already is kept. Return the number
        of clips that were changed.
        """
        from marey_client.bridges.returning import restore_clip

        notify = notice or _ignore_notice
        known = [(one.item, found.exported[one.name]) for one in entries if one.item and one.name in found.exported]
        changed = 0
        with CallPool(UPLOADS_AT_ONCE, thread_name_prefix="marey-restore") as pool:
            outcomes = pool.map(lambda pair: restore_clip(self.transport, self.project, *pair), known)
            for done, outcome in enumerate(outcomes, start=1):
                changed += outcome
                notify("restoring records", done, len(known))
        return changed

    def run(self, files: tuple[ImportFile, ...], options: ImportOptions | None = None) -> tuple[ImportEntry, ...]:
        """Import up to 1000 files whose bytes the server has; if the server imports them in a job, wait for the job."""
        given = options.model_dump(exclude_unset=True) if options else {}
        request = ImportRequest(files=files, **given)
        response = self.transport.send(
            "POST", f"/projects/{self.project}/imports", content=as_json(request), timeout_s=600.0
        )
        if response.status_code != 202:
            return read_model(ImportAnswer, response).entries
        job = self.jobs.wait(read_model(Job, response).id)
        return ImportAnswer.model_validate(job.result).entries

    def send(self, files: Sequence[LocalFile], *, notice: Notice | None = None) -> tuple[ImportFile, ...]:
        """Upload the bytes that the server does not have; return the files as an import request names them.

        Raises `BadFileName` if a name cannot be sent.
        """
        for file in files:
            if not _can_be_sent(file.name):
                raise BadFileName(refusal_text(_refused_name(file.name)))
        notify = notice or _ignore_notice
        digests: dict[str, str] = {}
        with CallPool(UPLOADS_AT_ONCE, thread_name_prefix="marey-upload") as pool:
            for file, digest in zip(files, pool.map(lambda file: digest_of_file(file.path), files), strict=True):
                digests[file.name] = digest
                notify("hashing", len(digests), len(files))
            lacking = self.blobs.missing(digests.values())
            by_digest = {digests[file.name]: file for file in files if digests[file.name] in lacking}
            # After a failure or an interruption, `map` cancels the uploads that have not begun.
            sending = pool.map(lambda one: self.blobs.put_file(one[1].path, digest=one[0]), by_digest.items())
            for done, _ in enumerate(sending, start=1):
                notify("sending", done, len(by_digest))
        return tuple(ImportFile(name=file.name, blob=digests[file.name]) for file in files)


def _can_be_sent(name: str) -> bool:
    """Return whether a request can contain a file name, which must be short UTF-8 text without control characters."""
    try:
        _FILE_NAME.validate_python(name)
    except ValidationError:
        return False
    return True


def _refused_name(name: str) -> ImportEntry:
    """Return the entry in the result of an import for a file that is refused because of its name."""
    shown = "".join(one if one.isprintable() else ascii(one)[1:-1] for one in name)
    detail = "its name is too long, is not UTF-8, or contains line breaks or other control characters; rename the file"
    return ImportEntry(name=shown, status="failed", error=Refusal(code="file-name", detail=detail))


def refusal_text(entry: ImportEntry) -> str:
    """Return the reason for a refusal as a line that begins with the file's name."""
    assert entry.error is not None
    detail = entry.error.detail
    if detail.startswith(entry.name):
        return f"{detail} ({entry.error.code})"
    line = f", line {entry.error.line}" if entry.error.line else ""
    joint = f", joint {entry.error.joint}" if entry.error.joint else ""
    return f"{entry.name}{line}{joint}: {detail} ({entry.error.code})"


def left_out_texts(paths: Sequence[Path]) -> list[str]:
    """Return one message for each kind of file that was left out: the number of files, the reason, and all names."""
    kinds: defaultdict[str, list[Path]] = defaultdict(list)
    for path in paths:
        kinds[_reason(path)].append(path)
    return [
        f"left out: {len(some)} {reason} ({', '.join(path.name for path in some)})"
        for reason, some in sorted(kinds.items())
    ]


def _reason(path: Path) -> str:
    ending = path.suffix.lower()
    kind = ending[1:].upper() or "without ending"
    if path.is_dir():
        return f"{'hidden' if path.name.startswith('.') else 'linked'} folder with motion: name it to import it"
    if not path.exists():
        return f"{kind}: a link that leads nowhere"
    if path.name.startswith("."):
        return f"hidden {kind}: name them to import them"
    if ending in OTHER_MOTION:
        return f"{kind}: not readable here, export as BVH"
    return f"{kind}: not motion"


def _ignore_notice(_stage: str, _done: int, _total: int) -> None:
    pass


def _listed(places: Iterable[Path]) -> str:
    return ", ".join(str(place) for place in places)

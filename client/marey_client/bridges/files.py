"""Export of a version as a tree of motion files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from marey_client.asynchronous.interruption import CallPool
from marey_client.bridges.folders import file_names, new_folder, require_free
from marey_client.bridges.sidecars import RECORDS, SidecarWriter
from marey_client.bridges.version import (
    EXPORTS_AT_ONCE,
    DatasetToExport,
    DescribedClip,
    ExportOptions,
    VersionToExport,
    version_to_export,
)
from marey_client.downloads import download_to
from marey_client.errors import CannotExport, RequestFailed
from marey_schemas.datasets.exports import SIDECAR, ExportedClip
from marey_schemas.datasets.layouts import Layout
from marey_schemas.encoding.digests import digest_of_file
from marey_schemas.formats import DEFAULT_FORMAT, DEFAULT_UNIT, WHOLE_FORMATS, format_named

if TYPE_CHECKING:
    from marey_client.progress import OnProgress
    from marey_schemas.datasets.commits import Commit


class FileExportOptions(ExportOptions, total=False):
    """Keyword arguments of exports to motion files."""

    format: str
    """Name of the format of the files; default: `DEFAULT_FORMAT`."""
    unit: str | None
    """Unit of lengths in the files; None: the unit of the format, or `DEFAULT_UNIT` if the format has several units."""


class ExportedVersion(NamedTuple):
    """Result of the export of a version: its commit, the new folder, and the number of exported clips."""

    commit: Commit
    folder: Path
    clips: int
    renamed: Mapping[str, str]
    """Names of files whose clips have paths that some systems refuse, by the path of the clip."""
    left_out: Mapping[str, int]
    """Number of entries that were not exported, because they are not clips; by kind."""


@dataclass(frozen=True)
class MotionFiles:
    """Motion files of a version: their format and unit, and the reason to include clips whose consent has ended."""

    version: VersionToExport
    format: str
    unit: str | None
    allow_expired_consent: str | None

    def header(self, layout: Layout) -> dict[str, object]:
        """Return the first members of the sidecar: the version, the layout, and the format and unit of the files."""
        identity = self.version.identity.model_dump(mode="json", exclude_none=True)
        return {**identity, "layout": layout, "format": self.format, "unit": self._unit}

    @property
    def _unit(self) -> str:
        units = format_named(self.format).units
        return (self.unit or DEFAULT_UNIT) if len(units) > 1 else units[0]

    @property
    def ending(self) -> str:
        """The ending of the file names, such as `.bvh`."""
        return format_named(self.format).endings[0]

    def write(
        self,
        folder: Path,
        names: Sequence[str],
        add: Callable[[ExportedClip], None],
        on_progress: OnProgress,
    ) -> None:
        """Write each clip to its file below `folder`; `names` are the paths of the files, in the order of the clips.

        Calls `add` with each clip that was written, in this order.
        """
        total, done = len(self.version.clips), 0
        with CallPool(EXPORTS_AT_ONCE, thread_name_prefix="marey-export") as pool:
            for group in self.version.described(pool):
                files = names[done : done + len(group)]
                digests = pool.map(self._write_one, group, [folder / name for name in files])
                for one, name, digest in zip(group, files, digests, strict=True):
                    add(one.clip.model_copy(update={"file": name, "digest": digest}))
                    done += 1
                    on_progress("writing files", done, total)

    def _write_one(self, one: DescribedClip, target: Path) -> str:
        """Write a clip to `target`; return the digest of the file."""
        query: dict[str, str | int | None] = {"format": self.format, "revision": one.entry.revision, "unit": self.unit}
        if self.allow_expired_consent is not None and one.entry.item in self.version.ended:
            query |= {"allow_expired_consent": "true", "consent_reason": self.allow_expired_consent}
        dataset = self.version.dataset
        url = f"{dataset.project_url}/{one.entry.kind.plural}/{one.entry.item}/export"
        try:
            download_to(dataset.transport, url, target, params=query)
        except RequestFailed as error:
            error.add_note(f"the clip is {one.entry.path}")
            raise
        return digest_of_file(target)


def prepare_files(
    dataset: DatasetToExport,
    version: str,
    target: Path,
    *,
    path: str = "",
    format: str = DEFAULT_FORMAT,  # noqa: A002
    unit: str | None = None,
    allow_expired_consent: str | None = None,
) -> MotionFiles:
    """Check whether a version can be exported to the new folder `target`, and read its entries below `path`.

    Raises `CannotExport` if files in this format do not contain both motion and skeleton, because a file without one of
    them cannot be imported again on its own. Also raises the errors of `require_free` and `version_to_export`.
    """
    if format not in WHOLE_FORMATS:
        raise CannotExport(
            f"{format!r} is not one of the formats whose files contain both motion and skeleton: "
            f"{', '.join(WHOLE_FORMATS)}; `marey download` writes other formats"
        )
    require_free(target)
    found = version_to_export(dataset, version, path, allow_expired_consent=allow_expired_consent)
    return MotionFiles(found, format, unit, allow_expired_consent)


def write_files(motions: MotionFiles, target: Path, on_progress: OnProgress) -> ExportedVersion:
    """Write a version to a new folder: a file for each clip, the sidecar, and a table of the take records."""
    version = motions.version
    names = file_names([one.path for one in version.clips], motions.ending, reserved=(SIDECAR, RECORDS))
    with new_folder(target) as folder, SidecarWriter(folder, motions.header("files")) as sidecar:
        motions.write(folder, names, sidecar.add, on_progress)
        sidecar.finish()
    return exported(version, target, names, motions.ending)


def exported(version: VersionToExport, target: Path, names: Sequence[str], ending: str) -> ExportedVersion:
    """Return the result of an export to files.

    `names` are the paths of the clips' files in the order of `version.clips`, without the folders that the layout puts
    above them, such as `data`.
    """
    pairs = zip((one.path for one in version.clips), names, strict=True)
    renamed = {path: name for path, name in pairs if name != path + ending}
    return ExportedVersion(version.commit, target, len(version.clips), renamed, version.left_out)

"""Export of a version as a dataset repository of the Hugging Face Hub.

The layout follows the Hub's documentation: a card `README.md` with YAML metadata, and a table `metadata.csv` whose
column `file_name` is the path of each file relative to the table. The Hub accepts at most 10,000 entries in a folder,
so the files are in subfolders of `data`.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from marey_client.bridges.files import ExportedVersion, MotionFiles, exported
from marey_client.bridges.folders import file_names, new_folder
from marey_client.bridges.sidecars import CARD, RECORD_FIELDS, RECORDS, TABLE, SidecarWriter, record_cells
from marey_schemas.datasets.exports import SIDECAR, ExportedClip, ExportedIdentity
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.progress import OnProgress

MOST_FILES_PER_FOLDER = 10_000

LICENCES = frozenset(
    {
        "afl-3.0", "agpl-3.0", "apache-2.0", "artistic-2.0", "bsd", "bsd-2-clause", "bsd-3-clause",
        "bsd-3-clause-clear", "bsl-1.0", "c-uda", "cc", "cc-by-2.0", "cc-by-2.5", "cc-by-3.0", "cc-by-4.0",
        "cc-by-nc-2.0", "cc-by-nc-3.0", "cc-by-nc-4.0", "cc-by-nc-nd-3.0", "cc-by-nc-nd-4.0", "cc-by-nc-sa-2.0",
        "cc-by-nc-sa-3.0", "cc-by-nc-sa-4.0", "cc-by-nd-4.0", "cc-by-sa-3.0", "cc-by-sa-4.0", "cc0-1.0",
        "cdla-permissive-1.0", "cdla-permissive-2.0", "cdla-sharing-1.0", "ecl-2.0", "etalab-2.0", "eupl-1.1", "gfdl",
        "gpl", "gpl-2.0", "gpl-3.0", "isc", "lgpl", "lgpl-2.1", "lgpl-3.0", "mit", "mpl-2.0", "odbl", "odc-by",
        "osl-3.0", "pddl", "unlicense", "wtfpl", "zlib",
    }
)  # fmt: skip
"""Identifiers of the licences that the metadata of a dataset card can name; any other licence becomes `other`."""

_SIZES = ("n<1K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M")


@dataclass
class _Summary:
    """Facts about the exported clips that the dataset card states."""

    licences: Counter[str | None] = field(default_factory=Counter)
    jobs: Counter[tuple[str, tuple[str, ...]] | None] = field(default_factory=Counter)
    """Number of clips, by kind and input commits of the job that made them; key None: clips that no job made."""

    def add(self, clip: ExportedClip) -> None:
        self.licences[clip.record.licence] += 1
        self.jobs[None if clip.job is None else (clip.job.kind, clip.job.commits)] += 1


def write_huggingface(motions: MotionFiles, target: Path, on_progress: OnProgress) -> ExportedVersion:
    """Write a version to a new folder that can be uploaded to the Hub without further changes."""
    version = motions.version
    plain = file_names([one.path for one in version.clips], motions.ending)
    names = [f"data/{place // MOST_FILES_PER_FOLDER:05d}/{name}" for place, name in enumerate(plain)]
    summary = _Summary()
    with new_folder(target) as folder:
        with (
            SidecarWriter(folder, motions.header("huggingface")) as sidecar,
            (folder / TABLE).open("w", encoding="utf-8", newline="") as file,
        ):
            table = csv.writer(file, lineterminator="\n")
            table.writerow(("file_name", "clip", "content", *RECORD_FIELDS))

            def add(clip: ExportedClip) -> None:
                sidecar.add(clip)
                summary.add(clip)
                table.writerow((clip.file, clip.path, clip.content, *record_cells(clip)))

            motions.write(folder, names, add, on_progress)
            sidecar.finish()
        card = dataset_card(version.identity, summary.licences, summary.jobs, motions.format)
        (folder / CARD).write_text(card, encoding="utf-8", newline="\n")
    return exported(version, target, plain, motions.ending)


def dataset_card(
    identity: ExportedIdentity,
    licences: Mapping[str | None, int],
    jobs: Mapping[tuple[str, tuple[str, ...]] | None, int],
    format: str,  # noqa: A002
) -> str:
    """Return the dataset card of a version: YAML metadata, and a text with the commit, the licences and the lineage.

    `licences` is the number of clips by licence. `jobs` is the number of clips by the job that made them.
    """
    clips = sum(licences.values())
    lines = ["---", *_metadata(identity, licences, clips, format), "---", ""]
    lines += [f"# {_plain(identity.dataset)}", ""]
    lines += [f"{counted(clips, 'motion clip')} as {format.upper()} files, exported from Marey.", ""]
    lines += ["## Version", "", *_version(identity), ""]
    lines += ["## Licences", ""]
    lines += [f"* {_plain(name or 'not recorded')}: {counted(licences[name], 'clip')}" for name in _sorted(licences)]
    lines += ["", "## Lineage", "", *_lineage(jobs), ""]
    lines += ["## Files", ""]
    lines += [f"* `{TABLE}`: a row for each clip, with the path of its file, its content digest and its take record"]
    lines += [f"* `{SIDECAR}`: the same facts, and the origin of each clip, for programs"]
    lines += [f"* `{RECORDS}`: the take records, as `marey record --table` reads them"]
    return "\n".join(lines) + "\n"


def _metadata(
    identity: ExportedIdentity,
    licences: Mapping[str | None, int],
    clips: int,
    format: str,  # noqa: A002
) -> Iterator[str]:
    known = sorted({_identifier(name) for name in licences})
    if len(known) == 1:
        yield f"license: {known[0]}"
    else:
        yield "license:"
        yield from (f"- {name}" for name in known)
    if "other" in known:
        others = [name for name in _sorted(licences) if name is not None and _identifier(name) == "other"]
        yield f"license_name: {_quoted(', '.join(others))}"
    yield f"pretty_name: {_quoted(identity.dataset)}"
    yield "tags:"
    yield from (f"- {tag}" for tag in ("motion-capture", "human-motion", format, "marey"))
    yield "size_categories:"
    yield f"- {size_category(clips)}"
    yield "configs:"
    yield "- config_name: default"
    yield "  data_files:"
    yield "  - split: train"
    yield f"    path: {TABLE}"
    yield "marey:"
    fields = identity.model_dump(mode="json", exclude_none=True)
    yield from (f"  {name}: {_quoted(value)}" for name, value in fields.items() if value)


def _identifier(licence: str | None) -> str:
    """Return the Hub's identifier of a licence: `unknown` for None, `other` for a licence that `LICENCES` lacks."""
    if licence is None:
        return "unknown"
    wanted = "-".join(licence.strip().casefold().split())
    return wanted if wanted in LICENCES else "other"


def size_category(count: int) -> str:
    """Return the Hub's name for a number of examples, such as `1K<n<10K`."""
    place = next((place for place in range(len(_SIZES)) if count < 10 ** (place + 3)), None)
    return "n>10M" if place is None else _SIZES[place]


def _version(identity: ExportedIdentity) -> list[str]:
    facts = {
        "dataset": identity.dataset, "commit": f"`{identity.commit}`", "tag": identity.tag, "folder": identity.folder,
        "author": identity.author, "time": identity.at, "message": identity.message,
    }  # fmt: skip
    return [f"* {name}: {value if name == 'commit' else _plain(value)}" for name, value in facts.items() if value]


def _lineage(jobs: Mapping[tuple[str, tuple[str, ...]] | None, int]) -> Iterator[str]:
    for made in sorted(jobs, key=lambda one: one or ("", ())):
        if made is None:
            yield f"* imported or edited by users: {counted(jobs[made], 'clip')}"
            continue
        kind, commits = made
        taken = f", from {', '.join(f'`{one}`' for one in commits)}" if commits else ""
        yield f"* made by jobs of the kind {kind}{taken}: {counted(jobs[made], 'clip')}"


def _sorted(licences: Mapping[str | None, int]) -> Sequence[str | None]:
    return sorted(licences, key=lambda name: (name is None, name or ""))


def _quoted(text: str) -> str:
    """Return a text as a YAML string in double quotes; such strings may contain the escapes of JSON."""
    return json.dumps(text)


def _plain(text: str) -> str:
    """Return a text in one line, in which characters that Markdown and HTML treat as markup are escaped."""
    return "".join(f"\\{one}" if one in "\\`*_[]<>#|&" else one for one in " ".join(text.split()))

"""Command-line arguments that name datasets and their versions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from marey_client.cli.terminal.failures import WrongUsage

if TYPE_CHECKING:
    from marey_client.handles.datasets import ImportedVersion
    from marey_client.handles.versions import DatasetHandle
    from marey_client.marey import Marey

SHOWN_DIGITS = 12
"""Number of digits of a commit's digest that tables show."""

DatasetPlace = Annotated[str, typer.Argument(metavar="PROJECT/DATASET", help="Dataset, such as lab/gaits.")]
VersionPlace = Annotated[
    str,
    typer.Argument(
        metavar="PROJECT/DATASET[@VERSION]",
        help="Dataset and version, such as lab/gaits@v1: a branch, a tag or a commit, with ~n for n commits earlier. "
        "Default: @main.",
    ),
]


class NamedVersion(NamedTuple):
    """Dataset and version that an argument names."""

    project: str
    dataset: str
    version: str

    def on(self, marey: Marey) -> DatasetHandle:
        """Return a handle of the dataset that the argument names."""
        return marey.project(self.project).datasets.at(self.dataset)


def parse(text: str, *, version: bool = False) -> NamedVersion:
    """Parse `project/dataset` or `project/dataset@version`; without a version, the result names `main`.

    Raises `WrongUsage` for other texts. Unless `version` is true, a text that names a version is refused, too.
    """
    place, at, named = text.partition("@")
    project, _, name = place.strip("/").partition("/")
    if not project or not name or "/" in name or (at and not named):
        raise WrongUsage(f"{text!r} names no dataset; write project/dataset, such as lab/gaits")
    if at and not version:
        raise WrongUsage(f"{text!r} names a version, but this command works on the dataset; write {place}")
    return NamedVersion(project, name, named or "main")


def imported(at: NamedVersion, made: ImportedVersion, *, server: str | None = None) -> str:
    """Return a sentence for the user that reports an import and ends with the command to run next.

    If the branch moved to the imported version, the next command checks out the branch; otherwise, the next command
    merges the version into the branch. `server` is the address of the server that has received the version; None for
    the default server, which the next command need not name.
    """
    name, digits = f"{at.project}/{at.dataset}", short(made.commit.digest)
    there = f" --server {server}" if server else ""
    if not made.moved:
        return (
            f"{name} contains the version {digits} now, but the branch {made.branch} has other versions and was not "
            f"moved; to merge them, run marey dataset merge {name}@{digits} --into {made.branch}{there}"
        )
    return (
        f"{made.branch} of {name} is at {digits} now; to update the folder, run marey dataset checkout "
        f"{name}@{made.branch}{there}"
    )


def short(digest: str | None) -> str | None:
    """Return the first digits of a commit's digest; None for None."""
    return None if digest is None else digest.partition(":")[2][:SHOWN_DIGITS]

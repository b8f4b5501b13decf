"""Commands `dataset push` and `dataset pull`: copies of versions between servers and projects."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.datasets.places import VersionPlace, imported, parse
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, connect, connect_other
from marey_client.cli.terminal.output import print_json, print_message
from marey_client.progress import progress

if TYPE_CHECKING:
    from marey_client.marey import Marey

TargetPlace = Annotated[
    str | None,
    typer.Argument(
        metavar="[PROJECT/DATASET]",
        help="Dataset that receives the versions; it is created if it does not exist. Default: the same project "
        "and name.",
    ),
]
TokenFile = Annotated[
    Path | None,
    typer.Option(
        "--other-token-file",
        help="File with a token for the other server; default: the token that `marey login` stored for the other "
        "server.",
    ),
]
Branch = Annotated[
    str | None,
    typer.Option(
        help="Branch of the target dataset that is moved to the version. Default: the branch that was copied, or main."
    ),
]


def add_to(dataset: typer.Typer) -> None:
    """Add the commands of this module to the group `marey dataset`."""
    for command in (push, pull):
        dataset.command()(command)


def push(
    context: typer.Context,
    place: VersionPlace,
    target: TargetPlace = None,
    to: Annotated[
        str | None, typer.Option(metavar="URL", help="Server to copy to. Default: the server that you copy from.")
    ] = None,
    token_file: TokenFile = None,
    branch: Branch = None,
    as_json: AsJson = False,
) -> None:
    """Copy a version and all versions before it to a dataset on another server, or in another project.

    Only data that the other dataset lacks is sent, and the versions keep their digests, authors and times. A tag is
    copied if you name it (lab/gaits@v1), unless the other dataset has a branch or tag of this name. The copy changes no
    folder: check out the version to get its clips. If the target branch has versions that your dataset lacks, the
    target branch does not move: pull these versions, merge, and push again.
    """
    with connect(context) as here, connect_other(to, token_file, here) as there:
        _copy(here, there, place, target, branch, as_json, server=to)


def pull(
    context: typer.Context,
    place: VersionPlace,
    target: TargetPlace = None,
    source: Annotated[
        str | None,
        typer.Option("--from", metavar="URL", help="Server to copy from. Default: the server that you copy to."),
    ] = None,
    token_file: TokenFile = None,
    branch: Branch = None,
    as_json: AsJson = False,
) -> None:
    """Copy a version and all versions before it from a dataset on another server, or in another project.

    Only data that your dataset lacks is fetched, and the versions keep their digests, authors and times. A tag is
    copied if you name it (lab/gaits@v1), unless your dataset has a branch or tag of this name. The copy changes no
    folder: check out the version to get its clips. If your branch has versions that the other dataset lacks, the branch
    does not move, and the command prints how to merge.
    """
    with connect(context) as here, connect_other(source, token_file, here) as there:
        _copy(there, here, place, target, branch, as_json)


def _copy(
    source: Marey,
    target: Marey,
    place: str,
    into: str | None,
    branch: str | None,
    as_json: bool,
    *,
    server: str | None = None,
) -> None:
    """Copy a version and print the result; `server` is the address of the target server, None if none was named."""
    at = parse(place, version=True)
    to = at if into is None else parse(into)
    if source is target and (at.project, at.dataset) == (to.project, to.dataset):
        raise WrongUsage("this would copy the dataset to itself; name another server by its URL, or another dataset")
    with progress() as advance:
        datasets = target.project(to.project).datasets
        made = datasets.pull(at.on(source), to.dataset, at.version, into=branch, on_progress=advance)
    if as_json:
        return print_json({"commit": made.commit.digest, "branch": made.branch, "moved": made.moved, "tag": made.tag})
    print_message(imported(to, made, server=server))
    if made.tag is not None:
        print_message(f"the tag {made.tag} was copied, too")
    return None

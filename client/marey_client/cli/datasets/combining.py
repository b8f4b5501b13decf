"""Dataset commands that apply or undo the changes of other commits on a branch: merge, cherry-pick and revert."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from marey_client.cli.datasets.places import NamedVersion, VersionPlace, parse, short
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message, print_table
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from marey_client.handles.versions import DatasetHandle, PickOptions
    from marey_schemas.datasets.merges import EntryConflict, MergeAnswer, Resolution, Side

CONFLICT = "PATH:KIND[/PART]"
"""Form of the values of --ours, --theirs and --base, which name an entry with a conflict, or one part of the entry."""

Into = Annotated[str, typer.Option(help="Branch that gets the changes.")]
CommitMessage = Annotated[str, typer.Option("--message", "-m", help="Message of the commit.")]
Preview = Annotated[bool, typer.Option("--preview", help="Show the result without recording it.")]
Ours = Annotated[
    list[str] | None,
    typer.Option(
        metavar=CONFLICT,
        help="Resolve the conflict in this entry, or in this part of it, with the content of the branch; may be "
        "repeated.",
    ),
]
Theirs = Annotated[
    list[str] | None,
    typer.Option(
        metavar=CONFLICT,
        help="Resolve the conflict in this entry, or in this part of it, with the content of the other version; may be "
        "repeated.",
    ),
]
Base = Annotated[
    list[str] | None,
    typer.Option(
        metavar=CONFLICT,
        help="Resolve the conflict in this entry, or in this part of it, with the content of the base, with which "
        "both sides are compared; may be repeated.",
    ),
]
Others = Annotated[
    str | None,
    typer.Option(
        metavar="SIDE",
        help="Resolve all conflicts that no other option resolves with the content of this side: ours, theirs or base.",
    ),
]
Parent = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=2,
        help="Needed for a merge commit: its changes are the differences from this parent. 1 is the branch "
        "before the merge, 2 is the version that was merged into the branch.",
    ),
]


def add_to(dataset: typer.Typer) -> None:
    """Add the commands of this module to the group `marey dataset`."""
    for command in (merge, cherry_pick, revert):
        dataset.command()(command)


def merge(
    context: typer.Context,
    place: VersionPlace,
    into: Into = "main",
    message: CommitMessage = "",
    preview: Preview = False,
    ours: Ours = None,
    theirs: Theirs = None,
    base: Base = None,
    others: Others = None,
    as_json: AsJson = False,
) -> None:
    """Merge a version into a branch. Changes of different parts of one entry are combined. In an annotation, labels of
    different frames are combined, too.

    If both sides have changed the same part of an entry, nothing is merged until each such conflict is decided by
    --ours, --theirs, --base or --others. The exit status is 1 while a conflict is left.
    """
    at = parse(place, version=True)
    choices = Decisions(resolutions_of(ours, theirs, base), others)

    def change(on: DatasetHandle, resolutions: Sequence[Resolution], preview: bool) -> MergeAnswer:
        return on.merge(at.version, into=into, message=message, resolutions=resolutions, preview=preview)

    _combine(context, at, into, as_json, choices, preview, change)


def cherry_pick(
    context: typer.Context,
    place: VersionPlace,
    into: Into = "main",
    parent: Parent = None,
    message: CommitMessage = "",
    preview: Preview = False,
    ours: Ours = None,
    theirs: Theirs = None,
    base: Base = None,
    others: Others = None,
    as_json: AsJson = False,
) -> None:
    """Repeat the changes of one commit on a branch.

    If the branch has changed the same part of an entry, nothing is recorded until each such conflict is decided by
    --ours, --theirs, --base or --others. The exit status is 1 while a conflict is left.
    """
    at = parse(place, version=True)
    choices = Decisions(resolutions_of(ours, theirs, base), others)

    def change(on: DatasetHandle, resolutions: Sequence[Resolution], preview: bool) -> MergeAnswer:
        return on.cherry_pick(at.version, **_pick_options(into, parent, message, preview, resolutions))

    _combine(context, at, into, as_json, choices, preview, change)


def revert(
    context: typer.Context,
    place: VersionPlace,
    into: Into = "main",
    parent: Parent = None,
    message: CommitMessage = "",
    preview: Preview = False,
    ours: Ours = None,
    theirs: Theirs = None,
    base: Base = None,
    others: Others = None,
    as_json: AsJson = False,
) -> None:
    """Undo the changes of one commit on a branch. Later changes stay.

    If a later commit has changed the same part of an entry, nothing is recorded until each such conflict is decided by
    --ours (the present content), --theirs (the content before the commit) or --base (the content of the commit). The
    exit status is 1 while a conflict is left.
    """
    at = parse(place, version=True)
    choices = Decisions(resolutions_of(ours, theirs, base), others)

    def change(on: DatasetHandle, resolutions: Sequence[Resolution], preview: bool) -> MergeAnswer:
        return on.revert(at.version, **_pick_options(into, parent, message, preview, resolutions))

    _combine(context, at, into, as_json, choices, preview, change)


def _pick_options(
    into: str, parent: int | None, message: str, preview: bool, resolutions: Sequence[Resolution]
) -> PickOptions:
    options: PickOptions = {
        "into": into, "message": message, "preview": preview, "resolutions": tuple(resolutions)
    }  # fmt: skip
    if parent is not None:
        options["parent"] = 1 if parent == 1 else 2
    return options


class Decisions(NamedTuple):
    """Decisions about conflicts: by the options --ours, --theirs and --base, and the side for all other conflicts."""

    given: Sequence[Resolution]
    others: str | None

    def complete(self, preview: Callable[[Sequence[Resolution]], MergeAnswer]) -> list[Resolution]:
        """Return the given decisions and, if `others` is a side, one for each conflict that `preview` still finds.

        Previews are repeated, because an answer lists a limited number of conflicts, and a decision can move an entry
        to a path that is taken. A conflict that is found again although it was decided gets no further decision.

        Raises `WrongUsage` if `others` is not a side.
        """
        from marey_schemas.datasets.merges import MOST_RESOLUTIONS, Resolution, Side

        found = list(self.given)
        if self.others is not None and self.others not in list(Side):
            raise WrongUsage(f"--others {self.others!r} names no side; write {', '.join(Side)}")
        while self.others is not None:
            added = []
            for one in preview(found).conflicts:
                partly = any((one.path, one.kind) == (known.path, known.kind) for known in self.given)
                part = one.parts[0] if partly else None
                resolution = Resolution(path=one.path, kind=one.kind, take=Side(self.others), part=part)
                stays = resolution in found and one.reason and one.segments is None
                added += [] if stays else [resolution]
            if not added or len(found) + len(added) > MOST_RESOLUTIONS:
                break
            found += added
        return found


def _combine(
    context: typer.Context,
    at: NamedVersion,
    into: str,
    as_json: bool,
    choices: Decisions,
    preview: bool,
    change: Callable[[DatasetHandle, Sequence[Resolution], bool], MergeAnswer],
) -> None:
    """Call `change` with a dataset, the decisions and `preview`, and print the result.

    The exit status is 1 if there are conflicts.
    """
    with connect(context) as marey, conflicts_printed(into=into, as_json=as_json):
        on = at.on(marey)
        found = change(on, choices.complete(lambda resolutions: change(on, resolutions, True)), preview)
    _print(found, into, as_json=as_json)
    if found.conflict_count:
        raise typer.Exit(1)


@contextmanager
def conflicts_printed(*, into: str, as_json: bool) -> Iterator[None]:
    """Print the conflicts and exit with status 1 if a merge in the `with` block is refused because of conflicts."""
    from marey_client.errors import Conflict
    from marey_schemas.datasets.merges import MergeAnswer

    try:
        yield
    except Conflict as error:
        if error.code != "merge-conflicts":
            raise
        _print(MergeAnswer.model_validate(error.context), into, as_json=as_json)
        raise typer.Exit(1) from None


def _print(found: MergeAnswer, into: str, *, as_json: bool) -> None:
    if as_json:
        print_json(found)
    else:
        _print_result(found, into)


def resolutions_of(
    ours: Sequence[str] | None, theirs: Sequence[str] | None, base: Sequence[str] | None
) -> list[Resolution]:
    """Return the decision for each conflict that the options --ours, --theirs and --base name."""
    from marey_schemas.datasets.merges import Side

    found: list[Resolution] = []
    for side, places in ((Side.OURS, ours), (Side.THEIRS, theirs), (Side.BASE, base)):
        for place in places or ():
            one = _resolution(place, side)
            if any(_order_matters(one, other) for other in found):
                raise WrongUsage(
                    f"two of --ours, --theirs and --base resolve {place!r}, a part of it, or its whole entry; give one "
                    "of them for the whole entry, or one for each of its parts"
                )
            found.append(one)
    return found


def _resolution(place: str, side: Side) -> Resolution:
    """Return the decision that a text such as `raw/walk:clip` or `raw/walk:clip/motion` describes."""
    from marey_schemas.datasets.merges import Resolution

    path, colon, named = place.rpartition(":")
    if not colon:
        raise WrongUsage(f"{place!r} names no kind; write path:kind, such as raw/walk:clip")
    kind, _, part = named.partition("/")
    return Resolution.model_validate({"path": path.strip("/"), "kind": kind, "take": side, "part": part or None})


def _order_matters(one: Resolution, other: Resolution) -> bool:
    """Return whether two decisions resolve the same conflict differently, so that the later one would win.

    The command line does not show which one is later, because options of different names have no order.
    """
    same_part = one.part == other.part or None in (one.part, other.part)
    return (one.path, one.kind) == (other.path, other.kind) and one.take != other.take and same_part


def _print_result(found: MergeAnswer, into: str) -> None:
    if found.conflict_count:
        rows = [(one.path, one.kind, ", ".join(one.parts)) for one in found.conflicts]
        print_table(("conflict", "kind", "changed on both sides"), rows)
        for one in found.conflicts:
            _print_reason(one)
        if found.conflict_count > len(rows):
            print_message(f"the first {len(rows):,} conflicts are listed")
        print_message(
            f"{counted(found.conflict_count, 'conflict')}; nothing was recorded. Decide each conflict by --ours, "
            "--theirs or --base, or all that are left by --others"
        )
    elif found.commit is None:
        print_message(f"{counted(found.changes, 'entry')} of {into} would change, without conflicts")
    else:
        print_message(
            f"{into} is at {short(found.commit.digest)} now; {counted(found.changes, 'entry')} changed. "
            "To update the folder, run `marey dataset checkout`"
        )


def _print_reason(conflict: EntryConflict) -> None:
    """Print why the changes or the resolution could not be applied, and the segments that cannot be combined."""
    from marey_schemas.datasets.merges import Side

    if conflict.reason:
        print_message(f"{conflict.path}: {conflict.reason}")
    if conflict.segments is not None:
        for side in Side:
            segments = getattr(conflict.segments, side)
            shown = ", ".join(f"{one.label} {one.start}:{one.end}" for one in segments)
            print_message(f"  {side}: {shown or 'none'}")

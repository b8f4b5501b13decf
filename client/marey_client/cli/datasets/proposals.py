"""Commands `proposal`, for changes that are reviewed before they are merged, and commands that protect branches."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.datasets.combining import (
    Base,
    CommitMessage,
    Decisions,
    Into,
    Others,
    Ours,
    Theirs,
    conflicts_printed,
    resolutions_of,
)
from marey_client.cli.datasets.places import DatasetPlace, VersionPlace, parse, short
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, connect, refuse_ignored
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table
from marey_schemas.datasets.proposal_states import CheckState, ProposalState, Verdict
from marey_schemas.kinds import Kind

if TYPE_CHECKING:
    from collections.abc import Sequence

    from marey_client.handles.proposals import ProposalHandle
    from marey_client.handles.versions import DatasetHandle
    from marey_schemas.datasets.merges import MergeAnswer, Resolution
    from marey_schemas.datasets.proposals import Comment, Proposal, ProposalDetail

proposal = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Manage proposals to merge a version of a dataset into a branch."
)

BranchPlace = Annotated[
    str, typer.Argument(metavar="PROJECT/DATASET[@BRANCH]", help="Branch, such as lab/gaits@main. Default: @main.")
]
CommitSeen = Annotated[
    str | None,
    typer.Option(
        "--commit",
        help="Newest commit that you have seen. The command is refused if the proposal has a newer commit.",
    ),
]
Number = Annotated[int, typer.Argument(min=1, help="Number of the proposal; `marey proposal ls` lists the numbers.")]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(proposal, name="proposal")


def add_protection_to(dataset: typer.Typer) -> None:
    """Add the commands that protect branches to the group `marey dataset`."""
    dataset.command()(protect)
    dataset.command()(unprotect)


@proposal.command("open")
def open_proposal(
    context: typer.Context,
    place: VersionPlace,
    title: Annotated[str, typer.Option("--title", "-t", help="Title: what the proposal changes, in a few words.")],
    description: Annotated[str, typer.Option(help="Reasons for the changes, and what reviewers should look at.")] = "",
    into: Into = "main",
    as_json: AsJson = False,
) -> None:
    """Propose to merge a version into a branch. If the version is a branch, its later commits are included."""
    at = parse(place, version=True)
    with connect(context) as marey:
        made = at.on(marey).proposals.open(title, at.version, into=into, description=description).read()
    if as_json:
        return print_json(made)
    return print_message(f"opened the proposal {made.number}; {_missing_words(made)}")


@proposal.command("ls")
def list_proposals(
    context: typer.Context,
    place: DatasetPlace,
    state: Annotated[
        ProposalState | None, typer.Option(help="List only proposals in this state. Default: in any state.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the proposals of a dataset, newest first."""
    at = parse(place)
    with connect(context) as marey:
        found = list(at.on(marey).proposals.list(state))
    if as_json:
        return print_json(found)
    rows = [(one.number, one.state, one.source, one.target, one.author, one.title) for one in found]
    return print_table(("number", "state", "source", "target", "author", "title"), rows)


@proposal.command("show")
def show(context: typer.Context, place: DatasetPlace, number: Number, as_json: AsJson = False) -> None:
    """Show a proposal with its comments, reviews and checks, and what is missing before it can be merged."""
    at = parse(place)
    with connect(context) as marey:
        handle = at.on(marey).proposals.at(number)
        found, comments = handle.read(), list(handle.comments())
    if as_json:
        return print_json({"proposal": found, "comments": comments})
    print_pairs(_pairs(found))
    if found.reviews or found.checks or comments:
        print_table(("who", "about", "what"), [*_verdicts(found), *map(_comment_row, comments)])
    return None


def _verdicts(found: ProposalDetail) -> list[tuple[str, str, str]]:
    """Return one table row for each review and check: its author, its subject, and its result with its text.

    The subject is the reviewed commit or the name of the check; the result is the verdict or the state.
    """
    reviews = [
        (one.author, f"{short(one.commit)}{', an earlier commit' if one.stale else ''}", f"{one.verdict} {one.text}")
        for one in found.reviews
    ]
    checks = [(one.reporter, f"check {one.name}", f"{one.state} {one.text}") for one in found.checks]
    return [(who, about, what.rstrip()) for who, about, what in (*reviews, *checks)]


def _comment_row(one: Comment) -> tuple[str, str, str]:
    where = "" if one.path is None else f"{one.path} ({one.kind})"
    return one.author, where if one.frames is None else f"{where}, frames {one.frames[0]}:{one.frames[1]}", one.text


def _pairs(found: ProposalDetail) -> list[tuple[str, object]]:
    computed = found.mergeability
    return [
        ("proposal", found.number),
        ("title", found.title),
        ("description", found.description),
        ("author", found.author),
        ("state", found.state),
        ("source", f"{found.source} at {short(found.head)}"),
        ("target", f"{found.target} at {short(found.target_commit)}"),
        ("merged", short(found.merged)),
        ("ended by", found.ended_by),
        ("merge requested by", found.when_green),
        ("changes", None if computed is None else computed.changes),
        ("conflicts", None if computed is None else computed.conflict_count),
        ("missing", "" if computed is None else " ".join(one.detail for one in computed.missing)),
    ]


def _missing_words(found: ProposalDetail) -> str:
    missing = () if found.mergeability is None else found.mergeability.missing
    return " ".join(one.detail for one in missing) or "nothing is missing, so it can be merged"


@proposal.command("comment")
def comment(
    context: typer.Context,
    place: DatasetPlace,
    number: Number,
    text: Annotated[str, typer.Argument(help="Text of the comment.")],
    entry: Annotated[
        str | None,
        typer.Option(
            metavar="PATH:KIND",
            help="Entry that the comment is about, such as "
            "raw/walk:clip. Default: the comment is about the "
            "whole proposal.",
        ),
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(
            metavar="FIRST:END",
            help="With --entry: range of frames that the comment is "
            "about; END is not included. Default: the whole entry.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Comment on a proposal, on one of its entries, or on frames of an entry."""
    at = parse(place)
    path, kind = _entry(entry)
    with connect(context) as marey:
        made = at.on(marey).proposals.at(number).comment(text, path=path, kind=kind, frames=_frames(frames))
    if as_json:
        return print_json(made)
    return print_message(f"added the comment {made.number}")


def _entry(text: str | None) -> tuple[str | None, Kind | None]:
    if text is None:
        return None, None
    path, colon, kind = text.rpartition(":")
    if not colon or kind not in set(Kind):
        raise WrongUsage(f"{text!r} names no kind; write path:kind, such as raw/walk:clip")
    return path.strip("/"), Kind(kind)


def _frames(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    first, _, end = text.partition(":")
    if not first.isdecimal() or not end.isdecimal():
        raise WrongUsage(f"{text!r} is not a range of frames; write FIRST:END, such as 120:180; END is not included")
    return int(first), int(end)


@proposal.command("review")
def review(
    context: typer.Context,
    place: DatasetPlace,
    number: Number,
    verdict: Annotated[Verdict, typer.Argument(help="Verdict of your review of the newest commit.")],
    text: Annotated[
        str, typer.Option("--message", "-m", help="Reasons for the verdict, which the proposal shows.")
    ] = "",
    commit: CommitSeen = None,
    as_json: AsJson = False,
) -> None:
    """Review the newest commit of a proposal. After a later commit, an approval does not count any more."""
    at = parse(place)
    with connect(context) as marey:
        made = at.on(marey).proposals.at(number).review(verdict, text, commit=commit)
    if as_json:
        return print_json(made)
    return print_message(f"recorded the verdict {made.verdict} for {short(made.commit)}")


@proposal.command("check")
def check(
    context: typer.Context,
    place: DatasetPlace,
    number: Number,
    name: Annotated[str, typer.Argument(help="Name of the check, such as evaluation.")],
    state: Annotated[CheckState, typer.Argument(help="State of the check.")],
    job: Annotated[
        str | None,
        typer.Option(
            help="Id of the job that ran the check. The state `succeeded` is accepted only if this job has succeeded "
            "and, if it read versions of datasets, has read the newest commit of the proposal."
        ),
    ] = None,
    link: Annotated[str | None, typer.Option(help="Address of a page about the check.")] = None,
    text: Annotated[str, typer.Option("--message", "-m", help="Explanation of the result of the check.")] = "",
    commit: CommitSeen = None,
    as_json: AsJson = False,
) -> None:
    """Report the state of a check of the newest commit of a proposal."""
    at = parse(place)
    with connect(context) as marey:
        handle = at.on(marey).proposals.at(number)
        made = handle.report_check(name, state, text=text, job=job, link=link, commit=commit)
    if as_json:
        return print_json(made)
    return print_message(f"the check {made.name} of {short(made.commit)} is {made.state}")


@proposal.command("merge")
def merge(
    context: typer.Context,
    place: DatasetPlace,
    number: Number,
    message: CommitMessage = "",
    commit: CommitSeen = None,
    ours: Ours = None,
    theirs: Theirs = None,
    base: Base = None,
    others: Others = None,
    when_green: Annotated[
        bool,
        typer.Option(
            "--when-green", help="If approvals or checks are missing, let the server merge as soon as none is missing."
        ),
    ] = False,
    withdraw: Annotated[
        bool, typer.Option("--withdraw", help="Cancel the merge that an earlier --when-green requested.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Merge a proposal into its target. If the proposal cannot be merged yet, the command lists the reasons.

    If both sides have changed the same part of an entry, nothing is merged until each such conflict is decided by
    --ours, --theirs, --base or --others, or resolved by a commit to the source. The exit status is 1 while a conflict
    is left.
    """
    at = parse(place)
    if withdraw:
        refuse_ignored(
            context, "with --withdraw", "message", "commit", "ours", "theirs", "base", "others", "when_green"
        )
    choices = Decisions(resolutions_of(ours, theirs, base), others)
    with connect(context) as marey:
        on = at.on(marey)
        handle = on.proposals.at(number)
        if withdraw:
            found = handle.withdraw_merge()
        else:
            resolutions, seen = _decided(on, handle, choices)
            with conflicts_printed(into="the target", as_json=as_json):
                found = handle.merge(
                    message=message, resolutions=resolutions, when_green=when_green, commit=commit or seen
                )
    return print_json(found) if as_json else print_message(_outcome(found))


def _decided(on: DatasetHandle, handle: ProposalHandle, choices: Decisions) -> tuple[Sequence[Resolution], str | None]:
    """Return the decisions about conflicts, and the proposed commit, or None if its conflicts were not read."""
    if choices.others is None:
        return choices.given, None
    found = handle.read()

    def preview(resolutions: Sequence[Resolution]) -> MergeAnswer:
        return on.merge(found.head, into=found.target, resolutions=resolutions, preview=True)

    return choices.complete(preview), found.head


def _outcome(found: Proposal) -> str:
    if found.state is ProposalState.MERGED:
        return f"merged; {found.target} is at {short(found.merged)} now"
    if found.when_green is not None:
        return f"the proposal {found.number} will be merged for {found.when_green} when nothing is missing any more"
    return f"the proposal {found.number} is open; no merge is requested"


@proposal.command("close")
def close(context: typer.Context, place: DatasetPlace, number: Number, as_json: AsJson = False) -> None:
    """Close a proposal without a merge; only the author of the proposal and maintainers may do this."""
    at = parse(place)
    with connect(context) as marey:
        found = at.on(marey).proposals.at(number).close()
    return print_json(found) if as_json else print_message(f"closed the proposal {found.number}")


# -- protection -------------------------------------------------------------------------------------------------------


def protect(
    context: typer.Context,
    place: BranchPlace,
    role: Annotated[
        str, typer.Option(help="Lowest role that may move the branch: contributor, maintainer or owner.")
    ] = "contributor",
    direct_commits: Annotated[
        bool, typer.Option("--direct-commits", help="Allow commits and merges without a proposal.")
    ] = False,
    approvals: Annotated[
        int,
        typer.Option(min=0, help="Number of approvals that a proposal needs; approvals by its author do not count."),
    ] = 0,
    checks: Annotated[
        list[str] | None,
        typer.Option(
            "--check",
            metavar="NAME",
            help="Name of a check that must succeed before a merge; may be repeated.",
        ),
    ] = None,
    up_to_date: Annotated[
        bool, typer.Option("--up-to-date", help="Merge a proposal only if it contains the newest commit of the branch.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Protect a branch from deletion and reset, and limit how it can be changed.

    If the branch is protected already, the options replace its present rule.
    """
    from marey_schemas.datasets.protection import ProtectionRule

    at = parse(place, version=True)
    rule = ProtectionRule.model_validate(
        {
            "role": role, "direct_commits": direct_commits, "approvals": approvals, "checks": tuple(checks or ()),
            "up_to_date": up_to_date,
        }
    )  # fmt: skip
    with connect(context) as marey:
        found = at.on(marey).protect(at.version, rule)
    return print_json(found) if as_json else print_message(f"the branch {found.name} is protected")


def unprotect(context: typer.Context, place: BranchPlace, as_json: AsJson = False) -> None:
    """Remove the protection of a branch."""
    at = parse(place, version=True)
    with connect(context) as marey:
        found = at.on(marey).unprotect(at.version)
    return print_json(found) if as_json else print_message(f"the branch {found.name} is not protected any more")

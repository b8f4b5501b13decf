"""Common parts of the commands that submit jobs: options, progress bar, and the output at the end of a job."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, missing_place
from marey_client.cli.revisions import find_revision, find_version
from marey_client.cli.terminal.failures import Refused, WrongUsage
from marey_client.cli.terminal.output import print_json, print_message, print_refused
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf
from marey_client.progress import progress, show_progress
from marey_schemas.validation.reasons import plain_reason
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.marey import Marey
    from marey_schemas.kinds import Kind
    from marey_schemas.queue.jobs import ExistingInput, Job

_COMMIT = OptionsOf("marey_schemas.queue.commits:CommitOptions")


@dataclass(frozen=True)
class _CommittingJob(OptionsOf):
    """Options of a job that creates items: options of the job, and options of the commit of its results."""

    @cached_property
    def options(self) -> tuple[Any, ...]:
        """The options of the job, then the options of the commit."""
        return (*self._job.options, *_COMMIT.options)

    def read(self, typed: Mapping[str, Any]) -> Chosen:
        """Return the fields of `JobCreate` that the given options set. Raises `WrongUsage` for invalid options."""
        from pydantic import ValidationError

        from marey_schemas.queue.commits import CommitOptions

        try:
            commit = CommitOptions.model_validate(_COMMIT.read(typed)).commit()
        except ValidationError as error:
            raise WrongUsage(f"--commit-to: {plain_reason(error.errors()[0])}") from None
        except ValueError as error:
            raise WrongUsage(str(error)) from None
        return {**self._job.read(typed), **({} if commit is None else {"commit": commit})}

    @property
    def _job(self) -> OptionsOf:
        return OptionsOf(self.model, short=self.short, only=self.only)


FINDINGS_JOB = OptionsOf("marey_schemas.queue.jobs:JobCreate", only=("priority", "cache"))
JOB = _CommittingJob("marey_schemas.queue.jobs:JobCreate", only=("priority", "cache"))
SEEDED_JOB = _CommittingJob("marey_schemas.queue.jobs:JobCreate", only=("seed", "priority", "cache"))
SCRIPT_RUN = _CommittingJob(
    "marey_schemas.queue.scripts:ScriptRunCreate", short={"message": "-m"}, only=("seed", "message")
)

Sources = Annotated[
    list[str],
    typer.Argument(
        help="Clips, folders of clips, or versions of datasets, all in one project: "
        "project/folder[/name[@revision]] or project/dataset@version[/folder]."
    ),
]
Into = Annotated[str, typer.Option(help="Folder for the results, in the same project.")]
Wait = Annotated[
    bool,
    typer.Option(
        "--wait/--no-wait", help="Wait until the job has ended. With --no-wait, print the id of the job instead."
    ),
]


def refuse_without_waiting(wait: bool, **options: object) -> None:
    """Raise `WrongUsage` if one of the options is given and the command does not wait for the end of the job.

    All of the options use results of the job.
    """
    given = [f"--{name.replace('_', '-')}" for name, value in options.items() if value]
    if given and not wait:
        use = "uses" if len(given) == 1 else "use"
        raise WrongUsage(
            f"{' and '.join(given)} {use} results of the job, but --no-wait does not wait for them; leave out --no-wait"
        )


def clips_at(marey: Marey, address: Address) -> ExistingInput:
    """Return the clip, the version of a dataset, or the folder at an address as the input of a job."""
    from marey_schemas.kinds import Kind

    return input_at(marey, address, Kind.CLIP, pinned=False)


def input_at(marey: Marey, address: Address, kind: Kind, *, pinned: bool = True) -> ExistingInput:
    """Return the input of a job at an address: an item, its revision after `@`, a version of a dataset, or a folder.

    For an item without `@`, the input is the newest revision: the newest one now if `pinned` is true, otherwise the
    newest one when the job is submitted. Raises `WrongUsage` if there is nothing at the address.
    """
    from marey_schemas.queue.jobs import CollectionInput, ItemInput

    found = find_revision(marey, address, [kind])
    if found is not None:
        item, revision = found
        return ItemInput(item=item.id, revision=revision or (item.item.revision if pinned else None))
    version = find_version(marey, address)
    if version is not None:
        return version
    named = address.path and not address.is_folder  # not the project, nor a folder by a final slash
    if named and marey.project(address.project).collections.at(address.path) is None:
        raise missing_place(marey, address, f"no {kind.noun} and no folder", [kind])
    return CollectionInput(collection=address.path)


def follow(
    marey: Marey, submitted: Job, *, wait: bool = True, as_json: bool = False, count: int | None = None, unit: str = ""
) -> Job | None:
    """Wait until a job has ended, and show a progress bar.

    The progress of a job with tasks is counted in tasks; if `count` is given, the progress is scaled to `count`
    units with the name `unit`. Without `wait`, print the job's id and return None. Raises `JobUnsuccessful` if the job
    did not succeed.
    """
    from marey_client.errors import NotFound, RequestFailed, UnexpectedAnswer, Unreachable

    if not wait:
        print_json(submitted) if as_json else typer.echo(submitted.id)
        return None
    seen = submitted
    try:
        with progress() as advance:

            def show(now: Job) -> None:
                nonlocal seen
                seen = now
                show_progress(now, advance, count, unit)

            show(submitted)
            return marey.jobs.wait(submitted.id, on_progress=show)
    except KeyboardInterrupt:
        print_message(
            f"{seen.id} continues on the server; `marey job show {seen.id}` shows it, "
            f"`marey job cancel {seen.id}` stops it"
        )
        raise
    except NotFound:  # the job is gone, or its project is
        raise
    except (Unreachable, UnexpectedAnswer, RequestFailed) as error:
        error.add_note(f"this does not stop {seen.id}; `marey job show {seen.id}` shows it")
        raise


def print_ended(ended: Job, as_json: bool, show: Callable[[dict[str, Any]], None] | None = None) -> None:
    """Print the refused inputs of a job, then call `show` with its result; without `show`, print the result's counts.

    Raises `Refused` if inputs were refused, or if the results could not be committed to the requested branch.
    """
    result = ended.result or {}
    refused = result.get("refused", ())
    if as_json:
        print_json(ended)
    else:
        print_refused(refused)
        (show or _shown_counts(ended, refused))(result)
    print_commit(ended)
    if refused:
        raise Refused


def print_commit(ended: Job) -> None:
    """Print the commit of a job's results. Raises `Refused` if the commit could not be added to the given branch."""
    if ended.commit is not None:
        print_message(commit_text(ended))
    if ended.publish_conflict is not None:
        raise Refused


def commit_text(ended: Job) -> str:
    """Return a sentence about the commit of a job that has ended."""
    from marey_client.cli.datasets.places import short

    commit, conflict = ended.commit, ended.publish_conflict
    assert commit is not None
    name = f"{commit.dataset}@{commit.branch}"
    if conflict is not None:
        place = f"{ended.project}/{commit.dataset}@{conflict.branch}"
        merge = f" To merge it, run marey dataset merge {place} --into {commit.branch}"
        advice = "" if conflict.branch is None else merge
        return f"{name} does not contain the results: {conflict.detail}{advice}"
    if commit.digest is None:
        return f"{name} already contains these results, so there is no new commit"
    return f"{name} is at {short(commit.digest)} now"


def _shown_counts(ended: Job, refused: Sequence[Any]) -> Callable[[dict[str, Any]], None]:
    def show(result: dict[str, Any]) -> None:
        counts = ", ".join(
            counted(value, name.removesuffix("s")) if name.endswith("s") else f"{value:,} {name}"
            for name, value in result.items()
            if isinstance(value, int)
        )
        typer.echo(f"{ended.id} {ended.state}" + (f": {counts}" if counts else "") + f"; {len(refused)} refused")

    return show

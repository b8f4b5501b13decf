"""Commands `study` that create studies, invite participants, show their progress, and withdraw them."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.addresses import Address, addresses_in_one_project, require_item
from marey_client.cli.evaluations import clips_in
from marey_client.cli.revisions import require_revision
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table
from marey_client.cli.viewing import InBrowser, page_address, show_page

if TYPE_CHECKING:
    from marey_client.handles.studies import StudyHandle
    from marey_client.marey import Marey

study = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Ask people which motions are most similar, and fit a metric."
)

StudyPlace = Annotated[str, typer.Argument(metavar="STUDY", help="The study: project/folder/name, or project/id.")]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(study, name="study")


def study_at(marey: Marey, text: str) -> StudyHandle:
    """Return the study at an address. Raises `WrongUsage` if there is none."""
    from marey_schemas.kinds import Kind

    found: StudyHandle = require_item(marey, Address.parse(text), [Kind.STUDY])
    return found


@study.command("create")
def create(
    context: typer.Context,
    sources: Annotated[list[str], typer.Argument(help="Clips, or folders of clips, of one project.")],
    name: Annotated[str, typer.Option(help="Folder and name of the study, such as studies/walks.")],
    consent: Annotated[Path, typer.Option(help="Text file to whose content participants consent.")],
    title: Annotated[str | None, typer.Option(help="Title that participants see; default: the name.")] = None,
    trials: Annotated[int, typer.Option(min=1, max=200, help="Number of answered trials of each participant.")] = 63,
    seconds: Annotated[
        float, typer.Option(min=1, max=120, help="Seconds that a participant has to answer a trial.")
    ] = 10.0,
    seed: Annotated[
        int, typer.Option(min=0, max=2**32 - 1, help="Seed of the random trials; the same seed draws the same trials.")
    ] = 0,
    as_json: AsJson = False,
) -> None:
    """Create a study of four to 100 clips, at their newest revisions."""
    from marey_schemas.documents.studies import MOST_MOTIONS, SHOWN

    addresses = addresses_in_one_project(sources)
    folder, _, last = name.strip("/").rpartition("/")
    try:
        text = consent.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise WrongUsage(f"{consent} cannot be read as text: {error}") from error
    with connect(context) as marey:
        project = marey.project(addresses[0].project)
        clips = {clip.id: clip for address in addresses for clip in clips_in(marey, address)}
        if not SHOWN <= len(clips) <= MOST_MOTIONS:
            raise WrongUsage(f"a study needs {SHOWN} to {MOST_MOTIONS} clips, but {len(clips)} were given")
        made = project.studies.design(
            last, list(clips.values()), consent_text=text, title=title, collection=folder, trials=trials,
            seconds=seconds, seed=seed,
        )  # fmt: skip
    if as_json:
        return print_json(made.item)
    return print_pairs([("study", made.path), ("id", made.id), ("motions", str(len(clips)))])


@study.command("show")
def show(
    context: typer.Context,
    place: Annotated[str, typer.Argument(metavar="STUDY", help="The study: project/folder/name[@revision].")],
    browser: InBrowser = False,
) -> None:
    """Print the address of a page with the design, the participants and the results, or open the page with --browser.

    The address signs in the first browser that opens it, once.
    """
    from marey_schemas.kinds import Kind
    from marey_schemas.sign_ins import STUDY_PATH

    address = Address.parse(place)
    with connect(context) as marey:
        found, revision = require_revision(marey, address, [Kind.STUDY])
        named = f"{address.project}/{found.id}" + ("" if revision is None else f"@{revision}")
        url = page_address(marey, address.project, STUDY_PATH, {"study": named})
    show_page(url, browser=browser)


@study.command("invite")
def invite(
    context: typer.Context,
    place: StudyPlace,
    count: Annotated[
        int,
        typer.Option("--count", "-n", min=1, max=100, help="Number of links to create; each is for one participant."),
    ] = 1,
    days: Annotated[
        int, typer.Option(min=1, max=180, help="Number of days within which participants must begin.")
    ] = 30,
    as_json: AsJson = False,
) -> None:
    """Create links, each for one participant without an account, and print the links, which are never shown again."""
    from marey_schemas.studies.participation import LINK_PATH

    with connect(context) as marey:
        made = study_at(marey, place).invite(count, lifetime=timedelta(days=days))
        server = marey.transport.url
    if as_json:
        return print_json(made)
    print_table(("participant", "link"), [(one.participant, f"{server}{LINK_PATH}{one.code}") for one in made.links])
    return print_message("send each link to one person: the server never shows the links again")


@study.command("status")
def status(context: typer.Context, place: StudyPlace, as_json: AsJson = False) -> None:
    """Show how many people have begun and finished, and how many trials they have answered."""
    with connect(context) as marey:
        found = study_at(marey, place).progress()
    if as_json:
        return print_json(found)
    return print_pairs([(name, str(value)) for name, value in found.model_dump().items()])


@study.command("participants")
def participants(context: typer.Context, place: StudyPlace, as_json: AsJson = False) -> None:
    """List the participants of a study under their pseudonyms. For maintainers and owners of the project."""
    with connect(context) as marey:
        found = list(study_at(marey, place).participants())
    if as_json:
        return print_json(found)
    rows = [(one.participant, one.state, one.answered, one.timeouts, one.revision, one.id) for one in found]
    return print_table(("participant", "state", "answered", "timeouts", "revision", "id"), rows)


@study.command("withdraw")
def withdraw(
    context: typer.Context,
    place: StudyPlace,
    participant: Annotated[
        str,
        typer.Argument(
            metavar="PARTICIPANT", help="Pseudonym or id of the participant; `marey study participants` lists both."
        ),
    ],
) -> None:
    """Withdraw a participant: delete the participant's consent and trials, and make the link invalid."""
    with connect(context) as marey:
        found = study_at(marey, place)
        named = [one for one in found.participants() if participant in (one.id, one.participant)]
        if len(named) != 1:
            raise WrongUsage(
                f"{participant!r} names {len(named)} participants; `marey study participants {place}` lists the ids"
            )
        found.withdraw(named[0].id)
    print_message(f"the records of {participant} are deleted")

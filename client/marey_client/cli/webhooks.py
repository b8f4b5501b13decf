"""Commands of the group `webhook`: addresses to which a server sends the events of a project."""

from __future__ import annotations

from datetime import timedelta
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, ProjectName, connect
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from marey_schemas.event_kinds import ProjectEventKind
    from marey_schemas.webhooks import DeliveryState, Webhook, WebhookDelivery

webhook = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Send the events of a project to the addresses of other programs."
)

WebhookId = Annotated[str, typer.Argument(metavar="ID", help="Id of the webhook; `marey webhook ls` lists the ids.")]
Url = Annotated[str, typer.Argument(help="Address to which requests are sent, such as https://ci.example.org/marey.")]
Kinds = Annotated[
    list[str] | None,
    typer.Option(
        "--kind",
        metavar="KIND",
        help="Kind of events to send, such as job.failed; repeat the option for several. The error for an unknown "
        "kind lists all kinds.",
    ),
]
Description = Annotated[str | None, typer.Option(help="Purpose of the webhook.")]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(webhook, name="webhook")


@webhook.command("create")
def create(
    context: typer.Context,
    project: ProjectName,
    url: Url,
    kind: Kinds = None,
    description: Description = None,
    as_json: AsJson = False,
) -> None:
    """Create a webhook, and print its secret, which is never shown again.

    Without --kind, the webhook reports moved branches, proposals, and jobs that have ended.
    """
    from marey_schemas.event_kinds import DEFAULT_WEBHOOK_KINDS

    kinds = _event_kinds(kind) or DEFAULT_WEBHOOK_KINDS
    with connect(context) as marey:
        made = marey.project(project).webhooks.create(url, kinds, description=description or "")
    if as_json:
        return print_json(made)
    print_pairs([("webhook", made.id), ("secret", made.secret)])
    return print_message("store the secret now: the server never shows it again")


def _event_kinds(given: Sequence[str] | None) -> tuple[ProjectEventKind, ...]:
    """Return the kinds of events that an option names. Raises `WrongUsage` for other texts."""
    from marey_schemas.event_kinds import PROJECT_EVENT_KINDS

    unknown = [one for one in given or () if one not in PROJECT_EVENT_KINDS]
    if unknown:
        raise WrongUsage(f"{unknown[0]!r} is not a kind of event; the kinds are {', '.join(PROJECT_EVENT_KINDS)}")
    return tuple(one for one in PROJECT_EVENT_KINDS if one in (given or ()))


@webhook.command("ls")
def list_webhooks(context: typer.Context, project: ProjectName, as_json: AsJson = False) -> None:
    """List the webhooks of a project."""
    with connect(context) as marey:
        found = list(marey.project(project).webhooks.list())
    if as_json:
        return print_json(found)
    rows = [(one.id, one.url, _state(one), one.delivered_at, one.dead, one.description) for one in found]
    return print_table(("id", "url", "state", "delivered", "given up", "description"), rows)


def _state(found: Webhook) -> str:
    if found.paused:
        return "paused"
    return f"failing ({found.last_error})" if found.failures else "active"


@webhook.command("show")
def show(context: typer.Context, project: ProjectName, webhook_id: WebhookId, as_json: AsJson = False) -> None:
    """Show a webhook and the result of its last attempt."""
    with connect(context) as marey:
        found = marey.project(project).webhooks.at(webhook_id).read()
    if as_json:
        return print_json(found)
    shown = found.model_dump(exclude={"kinds", "project", "failures", "dead", "missed"})
    counts = [("failed attempts", found.failures or None), ("given up", found.dead or None)]
    return print_pairs([*shown.items(), *counts, ("missed", found.missed or None), ("kinds", ", ".join(found.kinds))])


@webhook.command("change")
def change(
    context: typer.Context,
    project: ProjectName,
    webhook_id: WebhookId,
    url: Annotated[str | None, typer.Option(help="New address to which requests are sent. Default: unchanged.")] = None,
    kind: Kinds = None,
    description: Description = None,
    pause: Annotated[
        bool | None,
        typer.Option(
            "--pause/--resume", help="Pause deliveries, or resume them and send the waiting events. Default: unchanged."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Change, pause or resume a webhook. --kind replaces all kinds of events that the webhook reports."""
    from marey_schemas.webhooks import WebhookChange

    wanted = WebhookChange(url=url, kinds=_event_kinds(kind) or None, description=description, paused=pause)
    if not wanted.model_dump(exclude_none=True):
        raise WrongUsage("give at least one of --url, --kind, --description, --pause and --resume")
    with connect(context) as marey:
        found = marey.project(project).webhooks.at(webhook_id).change(wanted)
    return print_json(found) if as_json else print_message(f"{found.id} is changed; it is {_state(found)}")


@webhook.command("rm")
def remove(context: typer.Context, project: ProjectName, webhook_id: WebhookId) -> None:
    """Delete a webhook and its deliveries."""
    with connect(context) as marey:
        marey.project(project).webhooks.at(webhook_id).delete()
    return print_message(f"{webhook_id} is deleted")


@webhook.command("rotate")
def rotate(
    context: typer.Context,
    project: ProjectName,
    webhook_id: WebhookId,
    grace_minutes: Annotated[
        int,
        typer.Option(min=0, max=30 * 24 * 60, help="Minutes for which deliveries are also signed with the old secret."),
    ] = 24 * 60,
    as_json: AsJson = False,
) -> None:
    """Replace the secret of a webhook, and print the new secret, which is never shown again."""
    with connect(context) as marey:
        made = marey.project(project).webhooks.at(webhook_id).rotate(grace=timedelta(minutes=grace_minutes))
    if as_json:
        return print_json(made)
    print_pairs([("webhook", made.id), ("secret", made.secret)])
    return print_message(f"for {counted(grace_minutes, 'minute')}, deliveries are signed with the old secret, too")


@webhook.command("deliveries")
def deliveries(
    context: typer.Context,
    project: ProjectName,
    webhook_id: WebhookId,
    state: Annotated[
        str | None,
        typer.Option(
            help="List only deliveries in this state: waiting, retrying, delivered or dead. Default: in any state."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List deliveries that failed or that a user requested, newest first. Dead deliveries are not repeated any more."""
    with connect(context) as marey:
        found = list(marey.project(project).webhooks.at(webhook_id).deliveries(_delivery_state(state)))
    if as_json:
        return print_json(found)
    rows = [(one.id, one.kind, one.state, one.attempts, one.updated_at, one.last_error) for one in found]
    return print_table(("id", "kind", "state", "attempts", "changed", "last error"), rows)


def _delivery_state(text: str | None) -> DeliveryState | None:
    from marey_schemas.webhooks import DeliveryState

    for known in get_args(DeliveryState):
        if text == known:
            state: DeliveryState = known
            return state
    if text is None:
        return None
    raise WrongUsage(f"{text!r} is not a state of a delivery; the states are {', '.join(get_args(DeliveryState))}")


@webhook.command("redeliver")
def redeliver(
    context: typer.Context,
    project: ProjectName,
    webhook_id: WebhookId,
    delivery: Annotated[
        str | None,
        typer.Argument(metavar="DELIVERY", help="Id of the delivery; `marey webhook deliveries` lists the ids."),
    ] = None,
    all_dead: Annotated[
        bool,
        typer.Option(
            "--all", help="Send all dead deliveries again: failed deliveries that are not attempted any more."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Send a delivery again, or all dead deliveries. The exit status is 1 if a delivery fails."""
    if (delivery is None) != all_dead:
        raise WrongUsage("give either the id of a delivery, or --all")
    with connect(context) as marey:
        handle = marey.project(project).webhooks.at(webhook_id)
        ids = [one.id for one in handle.deliveries("dead")] if delivery is None else [delivery]
        for one in ids:
            handle.redeliver(one)
        found = [handle.wait(one) for one in reversed(ids)]
    return _print_results(found, as_json=as_json)


@webhook.command("test")
def send_test(context: typer.Context, project: ProjectName, webhook_id: WebhookId, as_json: AsJson = False) -> None:
    """Send a test event to a webhook, and print the result. The exit status is 1 if the delivery fails."""
    with connect(context) as marey:
        handle = marey.project(project).webhooks.at(webhook_id)
        found = handle.wait(handle.test().id)
    return _print_results([found], as_json=as_json)


def _print_results(found: Sequence[WebhookDelivery], *, as_json: bool) -> None:
    if as_json:
        print_json(found if len(found) != 1 else found[0])
    for one in found if not as_json else ():
        status = "" if one.last_status is None else f" with the status {one.last_status}"
        print_message(f"{one.id}: {one.last_error or f'{one.state}{status}'}")
    if any(one.state != "delivered" for one in found):
        raise typer.Exit(1)

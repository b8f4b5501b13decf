"""Commands `suggest`, `optimise` and `sweep`, which show how to improve a set of clips."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address
from marey_client.cli.evaluations import evaluation_at
from marey_client.cli.perception.metrics import MetricName, metric_at
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.following import FINDINGS_JOB, Wait, clips_at, follow, refuse_without_waiting
from marey_client.cli.terminal.invocation import AsJson, connect, output_option
from marey_client.cli.terminal.output import print_json, print_message, print_table
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from marey_client.handles.evaluations import EvaluationHandle
    from marey_client.handles.findings import Findings
    from marey_client.marey import Marey
    from marey_schemas.queue.jobs import ExistingInput, JobCreate

WEIGHT = {"objective": "--weight"}
SUGGEST = OptionsOf("marey_schemas.queue.job_params:SuggestParams", short=WEIGHT, without=("metric",))
OPTIMISE = OptionsOf("marey_schemas.queue.job_params:OptimiseParams", short=WEIGHT)
SWEEP = OptionsOf("marey_schemas.queue.job_params:SweepParams", short=WEIGHT)

SHOWN = 10
Evaluation = Annotated[str, typer.Argument(help="An evaluation: project/folder/name, or project/id.")]
From = Annotated[
    list[str] | None,
    typer.Option(
        "--from",
        help="Clip, or folder of clips, that could be added to the evaluated clips; may be repeated. It must be "
        "in the project of the evaluation.",
    ),
]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    add_command(app, suggest, params=SUGGEST, job=FINDINGS_JOB)
    add_command(app, optimise, params=OPTIMISE, job=FINDINGS_JOB)
    add_command(app, sweep, params=SWEEP, job=FINDINGS_JOB)


def suggest(
    context: typer.Context,
    evaluation: Evaluation,
    params: Chosen,
    job: Chosen,
    candidates: From = None,
    remove_out: Annotated[
        Path | None,
        typer.Option(
            help="Also write the paths of the clips whose removal has no effect on the trials to this file, one "
            "path per line."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        output_option(
            "Also write the report, an HTML page with pictures of the clips, to this file.",
        ),
    ] = None,
    metric: MetricName = None,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Find clips that can be removed from an evaluated set, and other clips that would fill gaps in its coverage."""
    refuse_without_waiting(wait, remove_out=remove_out, out=out)
    with connect(context) as marey:
        handle = evaluation_at(marey, evaluation)
        places = _places(marey, handle, candidates)
        request = handle.suggest_request(places, metric=metric_at(marey, metric), **params)
        found = submit_and_follow(marey, handle, request, job, wait, as_json)
        if found is None:
            return
        document = found.document()
        if out is not None:
            found.save_report(out)
    if remove_out is not None:
        from marey_client.downloads import write_whole

        names = [f"{clip['name']}\n" for clip in document["unused"]["clips"]]
        write_whole(remove_out, "".join(names))
        print_message(f"{counted(len(names), 'clip')} that can be removed: {remove_out}")
    print_findings(found, document, as_json, _print_suggestions)
    if out is not None and not as_json:
        print_message(f"report: {out}")


def optimise(
    context: typer.Context,
    evaluation: Evaluation,
    params: Chosen,
    job: Chosen,
    candidates: From = None,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Find clips to remove from an evaluated set, or to add to it, so that the results improve. No clip is changed."""
    with connect(context) as marey:
        handle = evaluation_at(marey, evaluation)
        request = handle.optimise_request(_places(marey, handle, candidates), **params)
        if (found := submit_and_follow(marey, handle, request, job, wait, as_json)) is not None:
            print_findings(found, found.document(), as_json, _print_steps)


def sweep(
    context: typer.Context,
    evaluation: Evaluation,
    params: Chosen,
    job: Chosen,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Repeat an evaluation with other weights of the features, and rank the features by their effect on the result."""
    with connect(context) as marey:
        handle = evaluation_at(marey, evaluation)
        if (found := submit_and_follow(marey, handle, handle.sweep_request(**params), job, wait, as_json)) is not None:
            print_findings(found, found.document(), as_json, _print_sweep)


# -- requests ---------------------------------------------------------------------------------------------------------


def submit_and_follow(
    marey: Marey, handle: EvaluationHandle, request: JobCreate, job: Chosen, wait: bool, as_json: bool
) -> Findings | None:
    """Submit a job, wait for its end, and return its findings.

    Without `wait`, the submitted job is printed instead, and the result is None.
    """
    from marey_client.handles.findings import Findings

    submitted = marey.project(handle.project).submit(request.model_copy(update=job))
    ended = follow(marey, submitted, wait=wait, as_json=as_json)
    return None if ended is None else Findings(marey.transport, ended)


def _places(marey: Marey, handle: EvaluationHandle, candidates: Sequence[str] | None) -> list[ExistingInput]:
    addresses = [Address.parse(place) for place in candidates or ()]
    for address in addresses:
        if address.project != handle.project:
            raise WrongUsage(f"{address}: candidates must be in the project of the evaluation, {handle.project}")
    return [clips_at(marey, address) for address in addresses]


def print_findings(
    found: Findings, document: Mapping[str, Any], as_json: bool, show: Callable[[Mapping[str, Any]], None]
) -> None:
    """Print the findings of a job: summary and document as JSON, or the document as text by calling `show`."""
    if as_json:
        print_json({"summary": found.summary, **_plain(document)})
    else:
        show(document)


# -- output -----------------------------------------------------------------------------------------------------------


def _print_suggestions(document: Mapping[str, Any]) -> None:
    unused, redundant = document["unused"], document["redundant"]
    plan = redundant["plan"]
    harmless = redundant.get("harmless_steps", len(plan))  # workers of older versions do not count them
    sections = (
        (f"{counted(len(unused['clips']), 'clip')} ({_seconds(unused['clips'])}) can be removed without changing any "
         "trial", unused["clips"]),
        (f"{counted(len(unused['ranges']), 'range')} of clips ({_seconds(unused['ranges'])}) can be cut off with "
         "hardly any change", unused["ranges"]),
        (f"{counted(harmless, 'clip')} to {'then ' if unused['clips'] else ''}remove, one after another; "
         f"{redundant['tried']} of {redundant['needed']} used clips were tried", plan[:harmless]),
        ("What still further removals cost", plan[harmless:]),
        (f"{counted(len(document['near_duplicates']['pairs']), 'pair')} of clips with nearly the same motion, within "
         f"{document['near_duplicates']['threshold_cm']:g} cm", document["near_duplicates"]["spared"]),
        (f"{counted(len(document['fillings']), 'clip')} would fill gaps in the coverage", document["fillings"]),
        ("Order in which to add clips", document["additions"]),
    )  # fmt: skip
    _print_sections(sections, document)
    if (chance := document["chance"].get("offset_mean")) is not None:
        typer.echo(
            f"By chance alone, the mean distance from the path varies by {100 * chance:.2f} cm between replicates "
            "(standard deviation)."
        )
    _print_similarity(document["similarity"])
    if (metric := document["near_duplicates"].get("metric")) is not None:
        typer.echo(
            f"Near-duplicates whose perceptual distance exceeds {document['near_duplicates']['most_perceived']:.2f} "
            f"are kept, because they look different; metric: {metric['name']}."
        )
    for one in document["unusable"]:
        print_message(
            f"{one['folder']}: {counted(one['clips'], 'clip')} cannot be matched: {one['detail']} ({one['code']})"
        )
    if not any(entries for _, entries in sections):
        typer.echo("No clip was found that can be removed, or that would fill a gap in the coverage.")


def _print_sections(sections: Sequence[tuple[str, Sequence[Mapping[str, Any]]]], document: Mapping[str, Any]) -> None:
    """Print lists of suggestions with reasons.

    Below a list of unused clips, print the effect of removing them all; below clips to add, how their quality compares
    with that of the set.
    """
    unused = document["unused"]
    below = (
        (unused["clips"], unused["confirmed_clips"]),
        (unused["ranges"], unused["confirmed_ranges"]),
        (document["fillings"], document.get("quality")),  # absent if the worker is of an older version
    )
    for heading, entries in sections:
        if not entries:
            continue
        typer.echo(f"{heading}.")
        for entry in entries[:SHOWN]:
            typer.echo(f"  {entry['reason']}")
        if len(entries) > SHOWN:
            typer.echo(f"  … and {len(entries) - SHOWN} more; --json has all.")
        for about, note in below:
            if about is entries and note is not None and note["reason"]:
                typer.echo(f"  {note['reason']}")
        typer.echo("")


def _print_similarity(similarity: Mapping[str, Any]) -> None:
    """Print the share of poses that can be blended, and the distance up to which they can, in metres or by a metric."""
    if similarity["share"] is None:
        return
    limit = f"{similarity['threshold_m']:.2f} m" if "threshold_m" in similarity else f"{similarity['threshold']:.2f}"
    typer.echo(
        f"{100 * similarity['share']:.0f} % of the poses have a pose of another clip of the same speed and turn rate "
        f"within {limit}, so they can be blended."
    )


def _seconds(entries: Sequence[Mapping[str, Any]]) -> str:
    return f"{sum(entry['seconds'] for entry in entries):.1f} s"


def _print_steps(document: Mapping[str, Any]) -> None:
    names = document["names"]
    rows = [
        (step["number"], step["action"], ", ".join(names.get(source, source) for source in step["sources"]),
         f"{step['objective']:.4f}", _confirmed(step["confirmed"]), f"{step['metrics']['offset_mean']:.4f}",
         f"{step['data_s']:.1f}", step["changed_trials"])
        for step in document["steps"]
    ]  # fmt: skip
    columns = ("step", "action", "clips", "objective m", "confirmed change m", "offset m", "data s", "trials changed")
    print_table(columns, rows, right=columns[3:])
    for one in document["unconfirmed"]:
        clips = ", ".join(names.get(source, source) for source in one["sources"])
        typer.echo(
            f"Not confirmed: {one['action']} {clips} seemed to change the objective by {-one['estimated_gain']:+.4f} "
            f"m; in other replicates, it changes by {_change(one['effect']['objective'])} m.{_chance_in_words(one)}"
        )
    reasons = {
        "no gain": "Ended because no further step gains enough.",
        "not confirmed": "Ended because the gain of no further step was confirmed.",
        "steps": "Ended at the greatest number of steps.",
        "evaluations": "Ended at the greatest number of sets to try.",
    }
    typer.echo(reasons[document["ended"]])
    if document["total"] is not None:
        change = _change(document["total"]["objective"])
        typer.echo(f"All steps together change the objective by {change} m, in replicates not used to choose them.")


def _confirmed(effect: Mapping[str, Any] | None) -> str:
    return "" if effect is None else _change(effect["objective"])


def _chance_in_words(refused: Mapping[str, Any]) -> str:
    """Return a sentence with the probability of an effect by chance, corrected for the number of candidates."""
    p = refused["effect"]["objective"]["p"]
    return "" if p is None else f" Among several candidates, chance alone changes it so much with probability {p:.2f}."


def _change(change: Mapping[str, Any]) -> str:
    """Return a change as text, with the interval in which 95 % of repetitions would lie, if it is known."""
    low, high = change["again_low"], change["again_high"]
    interval = "" if low is None else f" ({low:+.4f} to {high:+.4f})"
    return f"{change['change']:+.4f}{interval}"


def _print_sweep(document: Mapping[str, Any]) -> None:
    base = document["settings"][0]["weights"]
    rows = [
        (
            one["group"],
            f"{base[one['group']]:g}",
            f"{one['best_weight']:g}",
            f"{one['gain']:.4f}",
            f"{one['spread']:.4f}",
            "" if one["confirmed"] is None else _change(one["confirmed"]),
            "" if one["confirmed"] is None else one["confirmed"]["verdict"],
        )
        for one in document["influences"]
    ]
    columns = ("features", "weight", "best weight", "gain m", "spread m", "confirmed change m", "verdict")
    print_table(columns, rows, right=columns[1:6])
    typer.echo(f"The objective is {document['settings'][0]['objective']:.4f} m with the weights of the evaluation.")


def _plain(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with its arrays converted to lists."""
    import numpy as np

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return value.tolist()
        if isinstance(value, dict):
            return {name: plain(one) for name, one in value.items()}
        return [plain(one) for one in value] if isinstance(value, list) else value

    return {name: plain(value) for name, value in document.items()}

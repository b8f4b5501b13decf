"""`evaluate` and `report`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, find_item, require_item
from marey_client.cli.command_texts import is_frame
from marey_client.cli.failures import WrongUsage
from marey_client.cli.invocation import AsJson, connect
from marey_client.cli.jobs import clips_at, follow
from marey_client.cli.output import print_json, print_table, tell
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.handles.evaluations import EvaluationHandle
    from marey_client.marey import Marey
    from marey_schemas.job_params import EvaluateParams

WORST_SHOWN = 5
MOST_VALUES = 200


def add_to(app: typer.Typer) -> None:
    """Register the commands of this module."""
    app.command()(evaluate)
    app.command()(report)


def evaluate(
    context: typer.Context,
    sources: Annotated[list[str], typer.Argument(help="Clips or folders of clips, of one skeleton: project/folder.")],
    name: Annotated[str | None, typer.Option(help="Name of the result; default: that of the folder and -eval.")] = None,
    into: Annotated[str | None, typer.Option(help="Its folder in the project; default: beside the clips'.")] = None,
    speeds: Annotated[str | None, typer.Option(help="m/s: first:last:step or a,b,c; default 1:3:0.25.")] = None,
    turns: Annotated[
        str | None, typer.Option(help="degrees/s, positive to the left: first:last:step or a,b,c; default -100:100:25.")
    ] = None,
    families: Annotated[str | None, typer.Option(help="circle, switching, or both; default circle,switching.")] = None,
    approach: Annotated[float | None, typer.Option(help="Seconds straight ahead before the circle; default 3.")] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds of the circle; default 30.")] = None,
    mirror: Annotated[str | None, typer.Option(help="none, add (mirrored twins beside the clips) or only.")] = None,
    follow_mode: Annotated[str | None, typer.Option("--follow", help="time, path or open_loop; default time.")] = None,
    loop: Annotated[
        list[str] | None, typer.Option(help="A clip that is a loop, or a folder of such; may be repeated.")
    ] = None,
    trim: Annotated[
        list[str] | None, typer.Option(help="project/folder/clip=first:stop, the frames to use; may be repeated.")
    ] = None,
    end_policy: Annotated[
        str | None, typer.Option(help="What clips' ends look ahead to: clamp, trim, loop; default clamp, or loop.")
    ] = None,
    normaliser: Annotated[
        str | None, typer.Option(help="Use the scales of this evaluation, to be comparable: project/folder/name.")
    ] = None,
    baseline: Annotated[bool, typer.Option("--baseline/--no-baseline", help="Measure generated clips, too.")] = True,
    tag: Annotated[list[str] | None, typer.Option(help="Tag of the result; may be repeated.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "--output", "-o", help="Write the report to this file.")] = None,
    priority: Annotated[int, typer.Option(min=-100, max=100, help="Higher goes first.")] = 0,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until it has ended.")] = True,
    as_json: AsJson = False,
) -> None:
    """Measure how good locomotion clips are: accuracy, coverage and use, by simulated motion matching."""
    addresses = [Address.parse(source) for source in sources]
    if len({address.project for address in addresses}) > 1:
        raise WrongUsage("the clips must be in one project")
    if out is not None and not wait:
        raise WrongUsage("--out needs the result; leave --no-wait out")
    folder, _, last = addresses[0].path.rpartition("/")
    params = _params(
        name=name or (f"{last}-eval" if last else "evaluation"),
        tags=tuple(tag or ()) or None,
        speeds_m_s=_values(speeds),
        turn_rates_deg_s=_values(turns),
        families=tuple(families.split(",")) if families else None,
        approach_s=approach,
        duration_s=duration,
        baseline=baseline,
        database={"mirroring": mirror, "end_policy": end_policy or ("loop" if loop else None)},
        controller={"follow": follow_mode},
    )
    with connect(context) as marey:
        project = marey.project(addresses[0].project)
        loops = [one.id for place in loop or () for one in _clips_in(marey, Address.parse(place))]
        trims = dict(_trim(marey, text) for text in trim or ())
        pinned = evaluation_at(marey, normaliser).id if normaliser else None
        submitted = project.evaluate(
            [clips_at(marey, address) for address in addresses],
            into=folder if into is None else into.strip("/"),
            normaliser=pinned,
            priority=priority,
            **params.model_dump(exclude_unset=True),
            loops=loops,
            trims=trims,
        )
        if not wait:
            return print_json(submitted) if as_json else typer.echo(submitted.id)
        follow(marey, submitted, count=params.trial_count, unit="trials")
        found = project.evaluation(submitted)
        if out is not None:
            found.save_report(out)
        _print_evaluation(found, as_json)
    if out is not None:
        tell(f"report: {out}")
    return None


def report(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="An evaluation or a model: project/folder/name, or project/id.")],
    out: Annotated[Path, typer.Option("--out", "--output", "-o", help="The file to write.")] = Path("report.html"),
    figures: Annotated[
        Path | None, typer.Option(help="Write every figure to this folder: PNG, SVG, JSON, CSV.")
    ] = None,
    walk_graph: Annotated[
        Path | None, typer.Option(help="Write the walk graph of an evaluation to this file: .graphml or .json.")
    ] = None,
    trial: Annotated[str | None, typer.Option(help="The trial of the walk graph; default: all together.")] = None,
    open_it: Annotated[bool, typer.Option("--open", help="Show it in a browser.")] = False,
) -> None:
    """Write the report of an evaluation or a model to a file."""
    from marey_schemas.kinds import Kind

    if walk_graph is not None and walk_graph.suffix.lower() not in (".graphml", ".json"):
        raise WrongUsage(f"--walk-graph: {walk_graph} must end in .graphml or .json")
    if trial is not None and walk_graph is None:
        raise WrongUsage("--trial chooses the walks of --walk-graph; give that, too")
    kinds = [Kind.EVALUATION, Kind.MODEL] if walk_graph is None else [Kind.EVALUATION]
    with connect(context) as marey:
        found = require_item(marey, Address.parse(place), kinds)
        found.save_report(out)
        if walk_graph is not None:
            found.save_walk_graph(walk_graph, trial=trial)
        drawn = found.save_figures(figures) if figures is not None else []
    typer.echo(out)
    if walk_graph is not None:
        tell(f"walk graph: {walk_graph}")
    if figures is not None:
        tell(f"{counted(len(drawn), 'file')} of figures in {figures}")
    if open_it:
        import webbrowser

        webbrowser.open(out.absolute().as_uri())


def _clips_in(marey: Marey, address: Address) -> list[Any]:
    """The clip at an address, or all in a folder and below it."""
    from marey_schemas.kinds import Kind

    clip = find_item(marey, address, [Kind.CLIP])
    found = [clip] if clip is not None else list(marey.project(address.project).clips.list(collection=address.path))
    if not found:
        raise WrongUsage(f"there is no clip at {address}")
    return found


def _trim(marey: Marey, text: str) -> tuple[str, tuple[int, int]]:
    """Id of a clip and the frames to use of it."""
    from marey_schemas.kinds import Kind

    place, _, frames = text.rpartition("=")
    first, colon, stop = frames.partition(":")
    if not (place and colon and is_frame(first) and is_frame(stop)):
        raise WrongUsage(f"{text!r}: write project/folder/clip=first:stop, as in lab/walks/take=120:900")
    return require_item(marey, Address.parse(place), [Kind.CLIP]).id, (int(first), int(stop))


def evaluation_at(marey: Marey, place: str) -> EvaluationHandle:
    """The evaluation at a place. Raises `WrongUsage` where there is none."""
    from marey_schemas.kinds import Kind

    found: EvaluationHandle = require_item(marey, Address.parse(place), [Kind.EVALUATION])
    return found


def _params(**given: Any) -> EvaluateParams:
    """The options that were given; defaults stay those of the declaration."""
    from marey_schemas.job_params import EvaluateParams

    for group in ("database", "controller"):
        given[group] = {name: value for name, value in given[group].items() if value is not None} or None
    return EvaluateParams.model_validate({name: value for name, value in given.items() if value is not None})


def _values(text: str | None) -> tuple[float, ...] | None:
    """`1:3:0.25` as all its values with the last one, or `1,2,3` as they stand."""
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.replace(",", ":").split(":")]
    except ValueError:
        raise WrongUsage(f"{text!r}: write first:last:step, as in 1:3:0.25, or values, as in 1,1.5,2") from None
    if not all(map(math.isfinite, numbers)):
        raise WrongUsage(f"{text!r}: all values must be finite")
    if ":" not in text:
        return tuple(numbers)
    if "," in text or len(numbers) != 3:
        raise WrongUsage(f"{text!r}: a range is first:last:step, as in 1:3:0.25")
    first, last, step = numbers
    if not (step > 0 and last >= first):
        raise WrongUsage(f"{text!r}: a range goes up in steps above 0")
    steps = (last - first) / step + 1e-9
    if steps >= MOST_VALUES:
        raise WrongUsage(f"{text!r}: these are over {MOST_VALUES} values; at most so many are possible")
    count = int(steps) + 1
    return tuple(first + index * step for index in range(count))


def _print_evaluation(found: EvaluationHandle, as_json: bool) -> None:
    if as_json:
        return print_json({"evaluation": found.item, "summary": found.summary(), "trials": found.trials()})
    typer.echo(found.verdict)
    worst = sorted(found.trials(), key=lambda row: -(row["offset_mean"] or 0.0))[:WORST_SHOWN]
    rows = [(row["trial"], _number(row["offset_mean"], 2), _number(row["se_v"], 2), _number(row["se_omega_deg"], 1))
            for row in worst]  # fmt: skip
    columns = ("worst trials", "offset m", "speed error m/s", "turn error deg/s")
    print_table(columns, rows, right=columns[1:])
    return tell(f"{found.path}: marey report {found.project}/{found.path} --out report.html")


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"

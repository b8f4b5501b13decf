"""Options of commands that come from the models of jobs."""

import re
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from marey_client.cli.app import app
from marey_client.cli.clip_jobs import ALIGN, CUT
from marey_client.cli.evaluations import EVALUATE
from marey_client.cli.files.uploading import UPLOAD
from marey_client.cli.queue import jobs
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_schemas.options.imports import ImportOptions
from marey_schemas.options.modelling import ModelOptions
from marey_schemas.queue.job_params import AlignParams, EvaluateParams
from marey_schemas.queue.jobs import JobKind
from marey_schemas.search_constraints import JointOrientationConstraint, JointPositionConstraint
from marey_worker.supervisor import WorkerOptions

COMMANDS: Any = get_command(app)


def typed(arguments: str, options: OptionsOf) -> Chosen:
    """Return the options that a command receives for the given arguments."""
    got: list[Chosen] = []

    def command(params: Chosen) -> None:
        """Record the values that were typed."""
        got.append(params)

    one = typer.Typer()
    add_command(one, command, params=options)
    done = CliRunner().invoke(one, arguments.split())
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return got[0]


def help_of(options: OptionsOf, field: str) -> str:
    return next(one for one in options.options if one.path[-1] == field).help


@pytest.mark.parametrize(
    ("arguments", "chosen"),
    [
        ("", {}),
        ("--rate 30", {"rate_hz": 30.0}),
        ("--rate-hz 30", {"rate_hz": 30.0}),
        ("--label a --label b,c", {"labels": ["a", "b,c"]}),
        ("--weight Hips=2 --weight Head=0.5", {"weights": {"Hips": 2.0, "Head": 0.5}}),
        ("--slope-limit -1", {"slope_limit": None}),
        ("--slope-limit none", {"slope_limit": None}),
        ("--slope-limit 5", {"slope_limit": 5}),
        ("--no-keep-height", {"keep_height": False}),
        ("--mirror add", {"mirroring": "add"}),
    ],
)
def test_only_what_was_typed_is_given_in_the_types_of_the_model(arguments: str, chosen: Chosen) -> None:
    assert typed(arguments, ALIGN) == chosen
    AlignParams.model_validate(chosen)


def test_fields_of_nested_models_are_options_too() -> None:
    chosen = typed("--mirror add --follow path --weight hip_velocity=2 --speeds 1:2:0.5 --families circle", EVALUATE)
    assert chosen == {
        "speeds_m_s": [1.0, 1.5, 2.0],
        "families": ["circle"],
        "database": {"mirroring": "add", "weights": {"hip_velocity": 2.0}},
        "controller": {"follow": "path"},
    }
    EvaluateParams.model_validate(chosen)


def test_what_the_reader_of_files_can_be_told_an_upload_can_say() -> None:
    arguments = "--handedness left --align-floor --up-axis -z --fps 30 --unit-scale-m 0.01 --trim-rest-pose"
    given = ImportOptions.model_validate(typed(arguments, UPLOAD))
    assert given == ImportOptions(
        unit_scale_m=0.01, up_axis="-z", handedness="left", frame_rate_hz=30.0, trim_rest_pose=True, align_floor=True
    )


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("--rate-hz -1", "--rate-hz: the value must be above 0"),
        ("--window 2", "--window: the number of frames must be odd"),
        ("--slope-limit many", "--slope-limit: 'many' is not a number"),
        ("--weight Hips", "'Hips' does not have the form name=number"),
    ],
)
def test_what_the_model_refuses_is_told_with_the_option(arguments: str, told: str) -> None:
    with pytest.raises(WrongUsage) as refused:
        typed(arguments, ALIGN)
    assert str(refused.value).startswith(told)


def test_help_tells_meaning_range_and_default_of_the_schema() -> None:
    assert help_of(EVALUATE, "speeds_m_s").endswith("Above 0, at most 20; a,b,c or first:last:step; default 1:3:0.25.")
    assert help_of(EVALUATE, "baseline").endswith("Default on.")
    assert help_of(CUT, "margin_before_s").endswith("0 to 3600; default 0.")
    assert help_of(ALIGN, "slope_limit").endswith("none or -1: no limit. 0 to 60; default 3.")


@pytest.mark.parametrize(("command", "told"), [("evaluate", "followed by -eval"), ("model", "folder or clip")])
def test_help_tells_the_default_that_the_command_sets_instead_of_that_of_the_schema(command: str, told: str) -> None:
    found = COMMANDS.commands[command]
    (name,) = (option for option in found.get_params(typer.Context(found)) if "--name" in option.opts)
    assert told in name.help
    assert name.help.count("efault") == 1


def test_every_command_can_make_its_options_and_explains_each() -> None:
    def walk(command: Any, path: str) -> None:
        context = typer.Context(command, info_name=path)
        spelled = [one for option in command.get_params(context) for one in (*option.opts, *option.secondary_opts)]
        assert sorted(spelled) == sorted(set(spelled)), path
        unclear = [option.name for option in command.get_params(context) if not getattr(option, "help", "")]
        assert unclear == [], path
        untypable = [option.name for option in command.get_params(context) if "null" in (option.help or "")]
        assert untypable == [], path
        for name, child in getattr(command, "commands", {}).items():
            walk(child, f"{path} {name}")

    walk(COMMANDS, "marey")


def test_the_parameters_of_a_job_are_the_options_of_its_command() -> None:
    """A new field of a model becomes an option without a change of the command."""
    set_by_the_command = {"loops", "trims"}
    context = typer.Context(COMMANDS.commands["evaluate"])
    options = {one for option in COMMANDS.commands["evaluate"].get_params(context) for one in option.opts}
    nested = {"database", "controller"}
    for field in EvaluateParams.model_fields.keys() - set_by_the_command - nested:
        name = field.replace("_", "-")
        assert {f"--{name}", f"--{re.sub('s$', '', name)}"} & options, field


def test_the_help_of_a_worker_names_the_size_that_its_cache_has_by_default() -> None:
    command = COMMANDS.commands["worker"]
    (option,) = (one for one in command.get_params(typer.Context(command)) if one.name == "cache_mb")
    assert option.help.endswith(f"default: {WorkerOptions.cache_bytes >> 20}.")


def test_job_kinds_shows_type_range_and_default_of_each_parameter(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = JobKind(
        name="errand", description="Run.", inputs={}, outputs={}, params_schema=ModelOptions.model_json_schema()
    )
    marey = SimpleNamespace(jobs=SimpleNamespace(kinds=lambda: [kind]))
    monkeypatch.setattr(jobs, "connect", lambda _: nullcontext(marey))
    told = CliRunner().invoke(app, ["job", "kinds", "errand"]).stdout
    (line,) = (line for line in told.splitlines() if "spatial_components" in line)
    assert "whole number, 0 to 1000" in line
    (line,) = (line for line in told.splitlines() if "inner_product" in line)
    assert "coefficients or l2" in line
    assert '"coefficients"' in line


def test_the_help_of_a_search_names_the_tolerances_that_requests_have_by_default() -> None:
    """The help repeats the two numbers, because the command line loads no schemas before a command runs."""
    command = COMMANDS.commands["search"]
    helps = {option.name: option.help for option in command.get_params(typer.Context(command))}
    assert helps["tolerance_cm"].endswith(
        f"default: {100 * JointPositionConstraint.model_fields['tolerance_m'].default:g}."
    )
    assert helps["tolerance_deg"].endswith(
        f"default: {JointOrientationConstraint.model_fields['tolerance_deg'].default:g}."
    )

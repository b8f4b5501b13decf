"""Edit commands as text on the command line."""

from typing import Any

import pytest
from tests.support.edit_examples import commands_of_all

from marey_client.cli.editing.edit_commands import command_text, object_types, parameter_rows, parse_command
from marey_client.cli.terminal.failures import WrongUsage
from marey_schemas.editing.edits import COMMAND_MODELS, EditDocument


@pytest.mark.parametrize(
    ("text", "command"),
    [
        ("mirror", {"command": "mirror"}),
        ("trim start=10 stop=200", {"command": "trim", "start": 10, "stop": 200}),
        ("trim stop=null", {"command": "trim", "stop": None}),
        ("face heading_deg=-90", {"command": "face", "heading_deg": -90}),
        ("split at=10,20", {"command": "split", "at": [10, 20]}),
        ("split at=10", {"command": "split", "at": [10]}),
        ("translate shift_m=1,0,-2.5", {"command": "translate", "shift_m": [1, 0, -2.5]}),
        ("translate shift_m=[1,0,-2.5]", {"command": "translate", "shift_m": [1, 0, -2.5]}),
        ("smooth joints=Head,Neck frames=10:200", {
            "command": "smooth", "joints": ["Head", "Neck"], "frames": [10, 200],
        }),
        ("smooth frames=10: root_translation=false", {
            "command": "smooth", "frames": [10, None], "root_translation": False,
        }),
        ("smooth joints='Left Arm'", {"command": "smooth", "joints": ["Left Arm"]}),
        ("rotate_joint joint=7 axis=0,1,0 angle_deg=5", {
            "command": "rotate_joint", "joint": "7", "axis": [0, 1, 0], "angle_deg": 5,
        }),
        ("flip_axes up=-y forward=+z", {"command": "flip_axes", "up": "-y", "forward": "+z"}),
        ("constrain constraints='[{\"kind\": \"position\", \"joint\": \"Head\"}]'", {
            "command": "constrain", "constraints": [{"kind": "position", "joint": "Head"}],
        }),
        ('constrain constraints=[{"kind": "position", "joint": "Left Hand"}] limits=[] blend_s=0.5', {
            "command": "constrain", "constraints": [{"kind": "position", "joint": "Left Hand"}], "limits": [],
            "blend_s": 0.5,
        }),
        ('plant_feet contacts=[{"foot":"left","frames":[10,20]}]', {
            "command": "plant_feet", "contacts": [{"foot": "left", "frames": [10, 20]}],
        }),
    ],
)  # fmt: skip
def test_a_line_becomes_a_command(text: str, command: dict[str, Any]) -> None:
    assert parse_command(text) == command
    EditDocument.model_validate({"commands": [command]})


ODD_VALUES: list[dict[str, Any]] = [
    {"command": "smooth", "joints": ["Left Arm", "a,b", "it's", '"'], "frames": [10, None]},
    {"command": "smooth", "joints": ["7", "12"], "root_translation": False},
    {"command": "rotate_joint", "joint": "a b=c", "axis": [0, 1e-9, -2.5], "angle_deg": 5},
    {"command": "split", "at": [10]},
    {"command": "find_contacts", "height_limit_m": None},
]


@pytest.mark.parametrize("command", commands_of_all() + ODD_VALUES)
def test_the_text_of_a_command_is_read_as_the_same_command(command: dict[str, Any]) -> None:
    assert parse_command(command_text(command)) == command


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("wobble", "there is no command 'wobble'; the commands are trim"),
        ("", "there is no command"),
        ("smooth frames=10-20", "'10-20' is not a range of frames; write first:stop, as in 10:20"),
        ("trim begin=3", "trim has no parameter 'begin'; it has start, stop"),
        ("mirror left=1", "mirror has no parameter 'left'; it has none"),
        ("trim 3", "write parameter=value"),
        ("smooth joints='Head", "No closing quotation"),
        ("plant_feet contacts=[{foot:left}]", "is not a parameter with a value in JSON"),
    ],
)
def test_what_cannot_be_read_is_told_with_what_there_is(text: str, told: str) -> None:
    with pytest.raises(WrongUsage) as refused:
        parse_command(text)
    assert told in str(refused.value)


@pytest.mark.parametrize("name", sorted(COMMAND_MODELS))
def test_every_parameter_is_listed_with_its_type_and_default(name: str) -> None:
    rows = {row[0]: row for row in parameter_rows(COMMAND_MODELS[name])}
    assert set(rows) == set(COMMAND_MODELS[name].model_fields) - {"command"}
    assert all(kind and default for _, kind, default, _ in rows.values())


def test_objects_in_lists_are_described_with_their_fields() -> None:
    tables = {heading.partition(":")[0]: list(rows) for heading, rows in object_types(COMMAND_MODELS["constrain"])}
    kinds = ("position", "orientation", "look_at")
    assert list(tables) == [*(f"constraints, kind {kind}" for kind in kinds), "limits, kind hinge", "limits, kind cone"]
    assert ("joint", "text", "required") in [row[:3] for row in tables["limits, kind hinge"]]
    types = {row[0]: row[1] for row in parameter_rows(COMMAND_MODELS["constrain"])}
    assert types["constraints"] == "list of objects"

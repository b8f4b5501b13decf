"""Documents of edits: lists of commands that change clips."""

import json
from typing import Any

import pytest
from pydantic import ValidationError
from tests.support.edit_examples import commands_of_all

from marey_schemas.documents.registry import SCHEMAS
from marey_schemas.editing.edits import COMMAND_MODELS, EditDocument
from marey_schemas.encoding.codecs import BSON, JSON, MSGPACK, decode_tree, encode_tree
from marey_schemas.queue.job_kinds import find_kind
from marey_schemas.queue.job_params import EditParams


def edit_of(**given: Any) -> EditDocument:
    return EditDocument.model_validate(given)


@pytest.mark.parametrize("media_type", [JSON, MSGPACK, BSON])
def test_an_edit_survives_every_form_in_which_it_travels(media_type: str) -> None:
    edit = edit_of(title="everything", commands=commands_of_all())
    tree = edit.model_dump(mode="json", by_alias=True)
    assert SCHEMAS["marey/edit@1"].model_validate(decode_tree(encode_tree(tree, media_type), media_type)) == edit


def test_what_is_left_out_is_the_default_and_commands_keep_their_names() -> None:
    short = edit_of(commands=[{"command": "smooth"}])
    assert short == edit_of(commands=[short.commands[0].model_dump(mode="json")])
    assert short.model_dump(mode="json", exclude_unset=True) == {"commands": [{"command": "smooth"}]}


def test_defaults_may_be_left_out_but_not_the_names_of_commands_constraints_and_limits() -> None:
    command = {
        "command": "constrain",
        "constraints": [{"kind": "look_at", "joint": "Head", "point_m": [0.0, 1.0, 2.0]}],
        "limits": [{"kind": "hinge", "joint": "Neck", "angle_deg": [-10.0, 10.0]}],
    }
    edit = edit_of(commands=[command])
    assert edit.model_dump(mode="json", exclude_defaults=True) == {"commands": [command]}
    assert edit_of(**edit.model_dump(mode="json", exclude_defaults=True)) == edit


def test_the_clips_that_commands_name_are_listed_once() -> None:
    both = [
        {"command": "concatenate", "source": "clip_a"},
        {"command": "paste", "source": "clip_b", "joints": ["Head"]},
    ]
    assert edit_of(commands=both + both).sources == ("clip_a", "clip_b")
    assert edit_of(commands=[{"command": "mirror"}]).sources == ()


@pytest.mark.parametrize(
    "commands",
    [
        [],
        [{"command": "wobble"}],
        [{"start": 3}],
        [{"command": "trim", "start": -1}],
        [{"command": "trim", "start": 5, "stop": 5}],
        [{"command": "split", "at": []}],
        [{"command": "split", "at": [5, 5]}],
        [{"command": "split", "at": [0]}],
        [{"command": "concatenate"}],
        [{"command": "concatenate", "source": "a", "blend_s": -1}],
        [{"command": "resample", "frame_rate_hz": float("inf")}],
        [{"command": "translate", "shift_m": [1, 2]}],
        [{"command": "rotate", "angle_deg": float("nan")}],
        [{"command": "flip_axes", "up": "+z", "forward": "-z"}],
        [{"command": "smooth", "joints": []}],
        [{"command": "smooth", "frames": [10, 5]}],
        [{"command": "rotate_joint", "joint": "", "angle_deg": 1, "axis": [1, 0, 0]}],
        [{"command": "rotate_joint", "joint": "Head", "angle_deg": 1, "axis": [0, 0, 0]}],
        [{"command": "mirror"}] * 257,
    ],
)
def test_what_makes_no_sense_is_refused(commands: list[dict[str, Any]]) -> None:
    with pytest.raises(ValidationError):
        edit_of(commands=commands)


def test_results_in_place_have_no_suffix() -> None:
    with pytest.raises(ValidationError, match="keeps the names of the clips"):
        EditParams.model_validate({"commands": [{"command": "mirror"}], "in_place": True, "suffix": "-m"})


def test_every_command_and_parameter_is_described_in_the_schema_that_is_published() -> None:
    schema = json.dumps(find_kind("edit").document().params_schema)
    for name, model in COMMAND_MODELS.items():
        assert (model.__doc__ or "").strip().endswith("."), name
        assert f'"const": "{name}"' in schema
    vague = [
        f"{name}.{field}"
        for name, model in COMMAND_MODELS.items()
        for field, info in model.model_fields.items()
        if info.description is None and field not in ("command", "constraints")
    ]
    assert vague == []

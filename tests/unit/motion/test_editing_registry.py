"""Lists of commands: valid commands, errors, and equal bytes for equal lists."""

import inspect
from collections.abc import Callable
from math import degrees
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.edit_examples import commands_of_all
from tests.support.edited_takes import make_breathing_walk, make_walk, require_sound

from marey_motion.clip import Clip
from marey_motion.editing.registry import COMMANDS, EditedClip, apply_edit, edit_clip
from marey_motion.errors import EditError, MotionError
from marey_schemas.editing.commands import EXAMPLE_SOURCE, Mirror, NamedCommand, Rotate, Scale, Split, Trim
from marey_schemas.editing.edits import COMMAND_MODELS, EditDocument

FRAMES: dict[str, Callable[[int, dict[str, Any]], int]] = {
    "trim": lambda frames, given: (given.get("stop") or frames) - given.get("start", 0),
    "concatenate": lambda frames, given: frames + 180 - (30 if given.get("blend") == "slerp" else 0),
    "resample": lambda frames, given: int((frames - 1) * 45 / 60) + 1,
    "retime": lambda frames, given: int((frames - 1) / 0.7) + 1,
    "cut_loop": lambda frames, given: 65,  # one cycle of the walk
}
"""Total number of frames after a command, as a function of the frames before. Commands not listed keep the number."""


def edit_of(*commands: dict[str, Any]) -> EditDocument:
    return EditDocument.model_validate({"commands": list(commands)})


def applied(clip: Clip, *commands: dict[str, Any]) -> tuple[EditedClip, ...]:
    return edit_clip(clip, edit_of(*commands).commands, sources={EXAMPLE_SOURCE: make_walk(speed_m_s=2.5)})


def test_every_command_has_a_schema_and_every_schema_a_command() -> None:
    assert set(COMMANDS) == set(COMMAND_MODELS)
    assert all(model.examples for model in COMMAND_MODELS.values())


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_the_function_of_a_command_takes_the_model_that_declares_its_parameters(name: str) -> None:
    _take, command = inspect.signature(COMMANDS[name], eval_str=True).parameters.values()
    assert command.annotation is COMMAND_MODELS[name]
    assert command.default is inspect.Parameter.empty


@pytest.mark.parametrize("model", COMMAND_MODELS.values())
def test_the_name_of_a_command_is_its_default_in_python_and_required_in_documents(model: type[NamedCommand]) -> None:
    schema = model.model_json_schema()
    assert "command" in schema["required"]
    (given, *_) = model.examples
    command: Any = model(**given)
    assert command.model_dump(exclude_unset=True).keys() == {"command", *given}
    assert EditDocument(commands=(command,)) == edit_of(command.model_dump(mode="json", exclude_unset=True))


@pytest.mark.parametrize("command", commands_of_all(), ids=lambda command: command["command"])
@pytest.mark.parametrize("walk", [make_walk(turn_rate_rad_s=0.3), make_breathing_walk()], ids=["plain", "breathing"])
def test_every_command_makes_sound_clips_of_the_promised_length_and_leaves_its_clip_unchanged(
    command: dict[str, Any], walk: Clip
) -> None:
    before = walk.poses.copy()
    made = applied(walk, command)
    assert np.array_equal(walk.poses, before)
    for one in made:
        require_sound(one.clip)
        assert set(walk.translated_joints) <= set(one.clip.translated_joints)
    frames = sum(one.clip.frame_count for one in made)
    expected = FRAMES.get(command["command"], lambda frames, _given: frames)
    assert frames == expected(walk.frame_count, command)


@pytest.mark.parametrize("document", [{"command": "mirror"}, ("mirror", {})])
def test_a_document_in_place_of_a_command_is_refused_with_the_way_to_make_one(document: Any) -> None:
    with pytest.raises(EditError, match=r"EditDocument\.model_validate") as refused:
        edit_clip(make_walk(), [Mirror(), document])
    assert refused.value.where == "commands[1]"


def test_a_saved_edit_gives_the_same_bytes_every_time() -> None:
    long_list = [one for one in commands_of_all() if one["command"] not in ("split", "cut_loop")]
    edit = EditDocument.model_validate({"commands": long_list, "title": "all of it"})
    again = EditDocument.model_validate_json(edit.model_dump_json(by_alias=True))
    assert again == edit
    walk = make_breathing_walk()
    sources = {EXAMPLE_SOURCE: make_walk(speed_m_s=2.5)}
    (first,) = edit_clip(walk, edit.commands, sources=sources)
    (second,) = edit_clip(walk, again.commands, sources=sources)
    assert first.clip.poses.tobytes() == second.clip.poses.tobytes()
    assert first.clip.translations is not None
    assert second.clip.translations is not None
    assert first.clip.translations.tobytes() == second.clip.translations.tobytes()
    assert first.findings == second.findings


def test_several_commands_are_rounded_once() -> None:
    walk = make_walk()
    there_and_back = [Rotate(angle_deg=degrees(sign * 0.1)) for sign in (1.0, -1.0) for _ in range(30)]
    assert np.abs(apply_edit(walk, there_and_back).poses - walk.poses).max() < 3e-7


def test_what_goes_wrong_is_told_with_the_number_of_the_command() -> None:
    with pytest.raises(MotionError, match=r"commands\[1\] \(rotate_joint\), .*LeftHand") as refused:
        applied(
            make_walk(),
            {"command": "mirror"},
            {"command": "rotate_joint", "joint": "LeftHans", "axis": [1, 0, 0], "angle_deg": 5},
        )
    assert refused.value.code == "unknown-joint"


def test_unknown_commands_and_parameters_are_refused_by_name() -> None:
    with pytest.raises(ValidationError, match=r"'wobble'.*'trim', 'split'"):
        edit_of({"command": "wobble"})
    with pytest.raises(ValidationError, match=r"to\n  Extra inputs are not permitted"):
        Trim.model_validate({"to": 5})


def test_one_clip_is_not_asked_of_what_makes_several() -> None:
    with pytest.raises(EditError, match="split the clip into 2 clips"):
        apply_edit(make_walk(), [Split(at=[50])])


def test_numbers_that_overflow_are_refused_with_their_frame() -> None:
    with pytest.raises(MotionError, match="not finite"):
        apply_edit(make_walk(), [Scale(factor=1e4)] * 12)

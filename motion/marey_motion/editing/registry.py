"""Every command by its name, and lists of commands applied to clips.

A command is a function of a take and named parameters, and returns one take or several. It is pure: the same take and
parameters give the same bytes. Its parameters are plain trees in SI units, as `documents.commands_of_edit` makes them
from a document's; the schemas have the same names and defaults, with degrees (`_deg`) for radians (`_rad`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from marey_motion.clip import Clip
from marey_motion.editing.compute_budget import PER_COMMAND, PER_NUMBER, ComputeBudget
from marey_motion.editing.constraint_commands import constrain, plant_feet
from marey_motion.editing.frames import concatenate, resample, retime, split, trim
from marey_motion.editing.ground import find_contacts, find_ground, move_to_ground
from marey_motion.editing.joints import paste, rotate_joint
from marey_motion.editing.loops import close_loop
from marey_motion.editing.placement import face, fix_drift, flip_axes, mirror, move_to_origin, rotate, scale, translate
from marey_motion.editing.smoothing import smooth
from marey_motion.editing.take import MOST_NUMBERS, EditedBody, EditFinding, Take, motion_of, require_finite, settled
from marey_motion.errors import EditError, MotionError
from marey_motion.motion import Motion

Command = Callable[..., Take | tuple[Take, ...]]
NamedCommand = tuple[str, Mapping[str, Any]]

COMMANDS: Mapping[str, Command] = {
    command.__name__: command
    for command in (
        trim,
        split,
        concatenate,
        resample,
        retime,
        close_loop,
        translate,
        rotate,
        face,
        move_to_origin,
        scale,
        flip_axes,
        fix_drift,
        move_to_ground,
        find_ground,
        find_contacts,
        mirror,
        smooth,
        rotate_joint,
        paste,
        constrain,
        plant_feet,
    )
}
"""Commands by name. A new one gets its line here and its schema in `marey_schemas.editing.edits`."""


@dataclass(frozen=True, eq=False)
class EditedClip:
    """One result of an edit.

    Parameters
    ----------
    clip : the motion
    pieces : which piece it is, from 1, of each split it went through
    findings : what commands found out
    """

    clip: Clip
    pieces: tuple[int, ...]
    findings: tuple[EditFinding, ...]


def edit_clip(
    clip: Clip,
    commands: Sequence[NamedCommand],
    *,
    body: EditedBody | None = None,
    sources: Mapping[str, Clip] | None = None,
    most_numbers: int = MOST_NUMBERS,
    most_work: float = inf,
) -> tuple[EditedClip, ...]:
    """Apply commands to a clip.

    Computed in double precision throughout and rounded once, at the end.

    Parameters
    ----------
    clip : Clip    F frames; stays unchanged
    commands : sequence of (str, mapping)    names and parameters, in order; after a split, the rest applies to each
        piece
    body : EditedBody, optional    joints of the skeleton; by default inferred from names and build
    sources : mapping of str to Clip, optional    other clips by the names that the commands use
    most_numbers : int    largest size of the motion
    most_work : float    largest work of all commands together, in nanoseconds of one thread (`compute_budget`)

    Returns
    -------
    tuple of EditedClip    one, or several where it was split

    Raises
    ------
    MotionError    where a command cannot be applied; `where` names the command and the parameter
    """
    body = body or EditedBody(clip.skeleton)
    first = Take(
        motion_of(clip), clip.frame_rate_hz, body, sources or {}, most_numbers=most_numbers,
        budget=ComputeBudget(most_work),
    )  # fmt: skip
    takes: tuple[Take, ...] = (first,)
    for number, (name, parameters) in enumerate(commands):
        try:
            takes = tuple(one for take in takes for one in apply_command(take, name, parameters))
        except MotionError as error:
            place = f"commands[{number}] ({name})"
            error.where = place if error.where is None else f"{place}, {error.where}"
            raise
    with np.errstate(over="ignore"):  # what is too large in single precision is refused as not finite
        clips = [take.motion.as_clip(take.skeleton, take.frame_rate_hz) for take in takes]
    return tuple(EditedClip(clip, take.pieces, take.findings) for clip, take in zip(clips, takes, strict=True))


def apply_edit(clip: Clip, commands: Sequence[NamedCommand], **given: Any) -> Clip:
    """Apply commands that return a single clip, as `edit_clip`.

    Parameters
    ----------
    clip : Clip    F frames
    commands : sequence of (str, mapping)    names and parameters
    given    further arguments of `edit_clip`

    Returns
    -------
    Clip    the edited clip

    Raises
    ------
    EditError    where there are several
    """
    edited = edit_clip(clip, commands, **given)
    if len(edited) > 1:
        raise EditError(f"the commands make {len(edited)} clips of one", code="several-clips")
    return edited[0].clip


def apply_command(take: Take, name: str, parameters: Mapping[str, Any]) -> tuple[Take, ...]:
    """Apply one command to a take.

    Parameters
    ----------
    take : Take    F frames
    name : str    name of the command
    parameters : mapping    its parameters

    Returns
    -------
    tuple of Take    with rotations of unit length and continuous signs

    Raises
    ------
    MotionError    where it cannot be applied
    """
    command = COMMANDS.get(name)
    if command is None:
        raise EditError(f"no command is called {name!r}; there are {', '.join(COMMANDS)}", code="command-unknown")
    try:
        inspect.signature(command).bind(take, **parameters)
    except TypeError as error:
        raise EditError(f"{error}", code="command-invalid") from None
    take.budget.spend(PER_COMMAND + PER_NUMBER * _size_for(take, parameters))
    made = command(take, **parameters)
    return tuple(_settled(one, take.motion) for one in (made if isinstance(made, tuple) else (made,)))


def _size_for(take: Take, parameters: Mapping[str, Any]) -> int:
    """Count the numbers that a command works on: of the take, and of the clip that it names."""
    other = take.sources.get(parameters.get("source", ""))
    return take.size + (0 if other is None else other.poses.size)


def _settled(take: Take, before: Motion) -> Take:
    """Normalise rotations to unit length and continuous sign; frames that the command left alone are so already."""
    motion = take.motion
    if motion.root_translations is not before.root_translations:
        require_finite(motion.root_translations)
    if motion.translations is not before.translations:
        require_finite(motion.translations)
    return take if motion.rotations is before.rotations else take.moved(settled(motion))

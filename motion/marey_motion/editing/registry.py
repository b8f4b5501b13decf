"""Table of all commands by name, and functions that apply lists of commands to clips.

A command is an instance of a Pydantic model in `marey_schemas.editing`, which declares its parameters. The function of
the same name receives a take and the command, and returns one or more takes. The function is pure: the same take and
command give the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from marey_motion.clip import Clip
from marey_motion.editing.compute_budget import PER_COMMAND, PER_NUMBER, ComputeBudget
from marey_motion.editing.constraint_commands import constrain, plant_feet
from marey_motion.editing.frames import resample, retime, split, trim
from marey_motion.editing.ground import find_contacts, find_ground, move_to_ground
from marey_motion.editing.joining import concatenate
from marey_motion.editing.joints import paste, rotate_joint
from marey_motion.editing.loops import close_loop, cut_loop
from marey_motion.editing.placement import face, fix_drift, flip_axes, mirror, move_to_origin, rotate, scale, translate
from marey_motion.editing.smoothing import smooth
from marey_motion.editing.take import (
    MOST_NUMBERS,
    EditedBody,
    EditFinding,
    Take,
    motion_of,
    require_finite,
    with_unit_rotations,
)
from marey_motion.errors import EditError, MotionError
from marey_motion.motion import Motion
from marey_schemas.editing.commands import Concatenate, NamedCommand, Paste
from marey_schemas.editing.edits import AnyCommand

COMMANDS: Mapping[str, Callable[..., Take | tuple[Take, ...]]] = {
    command.__name__: command
    for command in (
        trim,
        split,
        concatenate,
        resample,
        retime,
        close_loop,
        cut_loop,
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
"""Functions by command name. A new command needs an entry here and a model in `marey_schemas.editing`.
"""


@dataclass(frozen=True, eq=False)
class EditedClip:
    """One result of an edit.

    Parameters
    ----------
    clip : the motion
    pieces : for each split that was applied, the number of the piece that contains this clip, counted from 1
    findings : values that the commands reported
    """

    clip: Clip
    pieces: tuple[int, ...]
    findings: tuple[EditFinding, ...]


def edit_clip(
    clip: Clip,
    commands: Sequence[AnyCommand],
    *,
    body: EditedBody | None = None,
    sources: Mapping[str, Clip] | None = None,
    most_numbers: int = MOST_NUMBERS,
    most_work: float = inf,
) -> tuple[EditedClip, ...]:
    """Apply commands to a clip.

    The computation is in double precision; the result is rounded to single precision once, at the end.

    Parameters
    ----------
    clip : Clip    F frames; stays unchanged
    commands : sequence of commands    in order; after a split, the remaining commands apply to each piece
    body : EditedBody, optional    joints of the skeleton; by default inferred from names and proportions
    sources : mapping of str to Clip, optional    other clips by the names that the commands use
    most_numbers : int    largest number of values that the motion may have
    most_work : float    largest work of all commands together, in nanoseconds of one thread (`compute_budget`)

    Returns
    -------
    tuple of EditedClip    one, or several if the clip was split

    Raises
    ------
    MotionError    if a command cannot be applied; `where` of the error is the command and the parameter
    """
    body = body or EditedBody(clip.skeleton)
    first = Take(
        motion_of(clip), clip.frame_rate_hz, body, sources or {}, most_numbers=most_numbers,
        budget=ComputeBudget(most_work),
    )  # fmt: skip
    takes: tuple[Take, ...] = (first,)
    for number, command in enumerate(commands):
        if not isinstance(command, NamedCommand):
            raise EditError(
                f"an object of type {type(command).__name__} is not a command; read documents with "
                "`EditDocument.model_validate`",
                code="command-invalid",
                where=f"commands[{number}]",
            )
        try:
            takes = tuple(one for take in takes for one in apply_command(take, command))
        except MotionError as error:
            place = f"commands[{number}] ({command.command})"
            error.where = place if error.where is None else f"{place}, {error.where}"
            raise
    with np.errstate(over="ignore"):  # values too large for single precision become infinite, which `Clip` refuses
        clips = [take.motion.as_clip(take.skeleton, take.frame_rate_hz) for take in takes]
    return tuple(EditedClip(clip, take.pieces, take.findings) for clip, take in zip(clips, takes, strict=True))


def apply_edit(clip: Clip, commands: Sequence[AnyCommand], **given: Any) -> Clip:
    """Apply commands to a clip, and return the single clip that they make (see `edit_clip`).

    Parameters
    ----------
    clip : Clip    F frames
    commands : sequence of commands    in order
    given    further arguments of `edit_clip`

    Returns
    -------
    Clip    the edited clip

    Raises
    ------
    EditError    if the commands make several clips
    """
    edited = edit_clip(clip, commands, **given)
    if len(edited) > 1:
        raise EditError(
            f"the commands split the clip into {len(edited)} clips, but a single clip was requested; use edit_clip",
            code="several-clips",
        )
    return edited[0].clip


def apply_command(take: Take, command: AnyCommand) -> tuple[Take, ...]:
    """Apply one command to a take.

    Parameters
    ----------
    take : Take    F frames
    command : command    with its parameters

    Returns
    -------
    tuple of Take    with rotations of unit length and continuous signs

    Raises
    ------
    MotionError    if the command cannot be applied
    """
    take.budget.spend(PER_COMMAND + PER_NUMBER * _size_for(take, command))
    made = COMMANDS[command.command](take, command)
    return tuple(_checked(one, take.motion) for one in (made if isinstance(made, tuple) else (made,)))


def _size_for(take: Take, command: AnyCommand) -> int:
    """Count the values that a command processes: the values of the take and of the source clip, if any."""
    other = take.sources.get(command.source) if isinstance(command, Concatenate | Paste) else None
    return take.size + (0 if other is None else other.poses.size)


def _checked(take: Take, before: Motion) -> Take:
    """Check that changed numbers are finite, and normalise changed rotations to unit length; return the take.

    The signs of the rotations are made continuous, too.
    """
    motion = take.motion
    if motion.root_translations is not before.root_translations:
        require_finite(motion.root_translations)
    if motion.translations is not before.translations:
        require_finite(motion.translations)
    return take if motion.rotations is before.rotations else take.with_motion(with_unit_rotations(motion))

"""Random lists of commands give a valid clip, or a refusal that names the faulty command."""

from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.support.edited_takes import make_breathing_walk, make_walk, require_sound
from tests.support.tiers import examples

from marey_motion.clip import Clip
from marey_motion.editing.registry import EditedClip, edit_clip
from marey_motion.errors import MotionError
from marey_schemas.editing.commands import FlipAxes, Trim
from marey_schemas.editing.edits import COMMAND_MODELS, AnyCommand

WALK = make_breathing_walk(seconds=0.8, turn_rate_rad_s=0.4)
OTHER = make_walk(seconds=0.5, rate_hz=30.0)
JOINTS = st.sampled_from(["LeftArm", "Head", "Spine1", "Hips", "RightToeBase"])
FRAMES = st.none() | st.tuples(st.integers(0, 20), st.none() | st.integers(21, 40))
ANGLES = st.floats(-400.0, 400.0)
SHIFTS = st.tuples(*[st.floats(-50.0, 50.0)] * 3)
AXES = SHIFTS.filter(lambda axis: np.linalg.norm(axis) > 0.1)
SECONDS = st.floats(0.0, 1.5)


def named(name: str, **parameters: st.SearchStrategy[Any]) -> st.SearchStrategy[AnyCommand]:
    return st.fixed_dictionaries(parameters).map(lambda chosen: COMMAND_MODELS[name](**chosen))


COMMAND = st.one_of(
    named("trim", start=st.integers(0, 10), stop=st.none() | st.integers(12, 40)),
    named("split", at=st.lists(st.integers(1, 40), min_size=1, max_size=3, unique=True).map(sorted)),
    named(
        "concatenate",
        source=st.just("other"),
        place=st.sampled_from(["seam", "keep"]),
        blend=st.sampled_from(["inertialise", "slerp"]),
        blend_s=SECONDS,
    ),
    named("resample", frame_rate_hz=st.sampled_from([12.0, 24.0, 59.94, 120.0])),
    named("retime", speed=st.floats(0.3, 3.0)),
    named("close_loop", in_place=st.booleans(), blend_s=st.none() | SECONDS),
    named("cut_loop", metric=st.sampled_from(["published/positions-sigmoid", "uniform/manhattan"])),
    named("translate", shift_m=SHIFTS),
    named("rotate", angle_deg=ANGLES, axis=AXES, pivot=st.sampled_from(["origin", "body"])),
    named("face", heading_deg=ANGLES, frame=st.integers(0, 5)),
    named("move_to_origin", frame=st.integers(0, 5)),
    named("scale", factor=st.floats(0.1, 10.0), translations=st.booleans()),
    st.sampled_from(
        [FlipAxes(up="+x", forward="-y"), FlipAxes(up="-y", forward="+z"), FlipAxes(up="+z", forward="-x")]
    ),
    named("fix_drift", shift_m=SHIFTS, turn_deg=ANGLES, frames=FRAMES, profile=st.sampled_from(["linear", "smooth"])),
    named("move_to_ground", height_m=st.none() | st.floats(-3.0, 3.0)),
    named("find_ground"),
    named("find_contacts"),
    named("mirror"),
    named(
        "smooth",
        method=st.sampled_from(["savitzky_golay", "gaussian"]),
        window_s=st.floats(0.05, 1.0),
        order=st.integers(0, 4),
        joints=st.none() | st.lists(JOINTS, min_size=1, max_size=3),
        root_translation=st.booleans(),
        frames=FRAMES,
        border_s=SECONDS,
    ),
    named(
        "rotate_joint",
        joint=JOINTS,
        angle_deg=ANGLES,
        axis=AXES,
        space=st.sampled_from(["joint", "parent", "world"]),
        frames=FRAMES,
        border_s=SECONDS,
    ),
    named(
        "paste",
        source=st.just("other"),
        joints=st.lists(JOINTS, min_size=1, max_size=3),
        frames=FRAMES,
        source_frames=st.none() | st.tuples(st.integers(0, 5), st.integers(6, 14)),
        border_s=SECONDS,
    ),
)

EXPECTED_REFUSALS = {
    "frames-missing",
    "edit-invalid",
    "heading-undefined",
    "no-period",
    "window-too-short",
    "window-too-long",
}


def outcome_of(commands: list[AnyCommand]) -> tuple[EditedClip, ...] | MotionError:
    try:
        return edit_clip(WALK, commands, sources={"other": OTHER})
    except MotionError as error:
        return error


def frames_after(clip: Clip, commands: list[AnyCommand]) -> int | None:
    """Return the number of frames after a list of commands, or None if the number is not easy to compute."""
    frames = clip.frame_count
    for command in commands:
        if isinstance(command, Trim):
            frames = (frames if command.stop is None else command.stop) - command.start
        elif command.command in ("concatenate", "resample", "retime", "cut_loop"):
            return None
    return frames


@settings(max_examples=examples(60, soak=150), suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(COMMAND, min_size=1, max_size=6))
def test_any_list_of_commands_makes_sound_clips_or_is_refused_in_words(commands: list[AnyCommand]) -> None:
    made = outcome_of(commands)
    if isinstance(made, MotionError):
        assert made.code in EXPECTED_REFUSALS, made
        assert str(made.where).startswith("commands[")
        return
    for one in made:
        require_sound(one.clip)
        assert np.isfinite(one.clip.poses).all()
    names = [command.command for command in commands]
    if "trim" not in names[1:] or "split" not in names:
        expected = frames_after(WALK, commands)
        assert expected is None or sum(one.clip.frame_count for one in made) == expected


@settings(max_examples=examples(10, soak=30))
@given(st.lists(COMMAND, min_size=1, max_size=4))
def test_the_same_list_gives_the_same_bytes(commands: list[AnyCommand]) -> None:
    def bytes_of() -> list[bytes] | str:
        made = outcome_of(commands)
        return str(made) if isinstance(made, MotionError) else [one.clip.poses.tobytes() for one in made]

    assert bytes_of() == bytes_of()

"""Conversion of clips to loops, without a visible jump from the last frame to the first."""

import numpy as np
import pytest
from tests.support.edited_takes import make_breathing_walk, make_walk, require_sound, same_poses, under_static_root

from marey_motion import kinematics
from marey_motion.clip import Clip
from marey_motion.editing.registry import apply_edit, edit_clip
from marey_motion.errors import EditError, MotionError
from marey_motion.gait import generate_gait
from marey_motion.kinematics import global_positions
from marey_motion.looping import LoopSeam, continue_motion, loop_seam
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.rigs import map_joints
from marey_schemas.editing.commands import CloseLoop, CutLoop


def seam_of(clip: Clip) -> LoopSeam:
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    positions = global_positions(clip).astype(np.float64)
    directions = kinematics.forward_directions(positions, body.lefts, body.rights)
    return loop_seam(positions[:, body.hips][:, [0, 2]], kinematics.headings(directions))


def accelerations_around_the_seam(clip: Clip, seam: LoopSeam) -> np.ndarray:
    """Return, for each frame around the seam, the largest change of a joint's step, in metres."""
    rounds = continue_motion(Motion.of(clip), seam, 3, 3)
    both = rounds.positions(clip.skeleton)[: 3 + 3]
    return np.linalg.norm(np.diff(both, n=2, axis=0), axis=-1).max(axis=1)


@pytest.mark.parametrize("in_place", [False, True])
@pytest.mark.parametrize("turn_rate_rad_s", [0.0, 0.7])
def test_the_last_frame_leads_into_the_first(in_place: bool, turn_rate_rad_s: float) -> None:
    walk = make_breathing_walk(turn_rate_rad_s=turn_rate_rad_s).sliced(5, 100)
    closed = apply_edit(walk, [CloseLoop(in_place=in_place)])
    assert closed.frame_count == walk.frame_count
    require_sound(closed)
    seam = LoopSeam(0.0, np.zeros(2)) if in_place else seam_of(closed)
    usual = np.linalg.norm(np.diff(global_positions(closed).astype(np.float64), n=2, axis=0), axis=-1).max()
    open_jump = accelerations_around_the_seam(walk, seam_of(walk)).max()
    closed_jump = accelerations_around_the_seam(closed, seam).max()
    assert closed_jump < 1.5 * usual
    assert closed_jump < 0.5 * open_jump


def test_a_loop_in_place_ends_where_it_starts() -> None:
    walk = make_walk(turn_rate_rad_s=0.7).sliced(5, 100)
    closed = apply_edit(walk, [CloseLoop(in_place=True)])
    seam = seam_of(closed)
    assert abs(seam.turn_rad) < 0.02
    assert np.abs(seam.shift_m).max() < 0.02


def test_poses_far_from_the_seam_stay_where_the_blend_is_short() -> None:
    walk = make_walk().sliced(5, 125)
    closed = apply_edit(walk, [CloseLoop(blend_s=0.3)])
    assert same_poses(closed.sliced(18, 102), walk.sliced(18, 102))
    assert not same_poses(closed.sliced(0, 10), walk.sliced(0, 10))


def test_what_loops_already_hardly_changes() -> None:
    walk = make_walk().sliced(5, 100)
    once = apply_edit(walk, [CloseLoop()])
    twice = apply_edit(once, [CloseLoop()])
    first, second = (
        np.abs(global_positions(after) - global_positions(before)).max()
        for before, after in ((walk, once), (once, twice))
    )
    assert second < 0.2 * first


def test_a_loop_needs_some_frames() -> None:
    with pytest.raises(EditError, match="at least 4 frames, but the clip has 3"):
        apply_edit(make_walk().sliced(0, 3), [CloseLoop()])
    assert apply_edit(make_walk().sliced(0, 4), [CloseLoop()]).frame_count == 4


@pytest.mark.parametrize("in_place", [False, True])
def test_a_body_under_a_static_root_is_looped_as_a_body_that_is_the_root(in_place: bool) -> None:
    walk = make_walk(turn_rate_rad_s=0.7).sliced(5, 100)
    closed, own = (apply_edit(clip, [CloseLoop(in_place=in_place)]) for clip in (under_static_root(walk), walk))
    require_sound(closed)
    assert np.abs(global_positions(closed)[:, 1:] - global_positions(own)).max() < 1e-4
    assert np.abs(closed.rotations[:, 0] - (1.0, 0.0, 0.0, 0.0)).max() < 1e-5


@pytest.mark.parametrize("turn_rate_rad_s", [0.0, 0.5])
def test_one_cycle_of_a_walk_is_cut_into_a_loop_that_closes(turn_rate_rad_s: float) -> None:
    walk = generate_gait(1.4, turn_rate_rad_s, 6.0, frame_rate_hz=60.0)
    (cut,) = edit_clip(walk, [CutLoop()])
    (finding,) = cut.findings
    first, end = finding.values["frames"]
    assert cut.clip.frame_count == end - first == round(60 * finding.values["period_s"])
    assert 0.6 <= finding.values["period_s"] <= 2.0
    require_sound(cut.clip)
    usual = np.linalg.norm(np.diff(global_positions(walk).astype(np.float64), n=2, axis=0), axis=-1).max()
    assert accelerations_around_the_seam(cut.clip, seam_of(cut.clip)).max() < 1.2 * usual
    turned = finding.values["turn_deg"] / finding.values["period_s"]
    assert turned == pytest.approx(np.degrees(turn_rate_rad_s), abs=3.0)
    assert finding.values["travel_m"] / finding.values["period_s"] == pytest.approx(1.4, rel=0.1)


def test_a_clip_without_a_cycle_is_left_alone_with_a_reason() -> None:
    with pytest.raises(MotionError, match="two periods"):
        apply_edit(make_walk().sliced(0, 40), [CutLoop()])
    with pytest.raises(EditError, match="more computing time"):
        apply_edit(generate_gait(1.4, 0.0, 6.0), [CutLoop()], most_work=1e7)

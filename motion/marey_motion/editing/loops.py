"""Edit commands that make a clip repeat without a visible seam: `close_loop` and `cut_loop`."""

from __future__ import annotations

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.editing.compute_budget import PER_COMPARED_POSES
from marey_motion.editing.offsets import VELOCITY_S, add_offset, decayed_offset, offset_to, step_of
from marey_motion.editing.placement import body_track, carried, moved_over
from marey_motion.editing.take import EditFinding, Take
from marey_motion.errors import EditError
from marey_motion.looping import LoopSeam, about_vertical, loop_seam, rotated
from marey_motion.motion import Motion
from marey_motion.perception import cycles
from marey_motion.perception.measuring import measure_motion
from marey_motion.perception.metric import metric_of
from marey_motion.root_carrier import body_first, root_first, root_stands
from marey_schemas.documents.metrics import built_in_metric
from marey_schemas.editing.commands import CloseLoop, CutLoop

FEWEST_FRAMES = 4


def close_loop(take: Take, command: CloseLoop) -> Take:
    """Make the last frame lead into the first frame, which may be elsewhere on the ground if the clip travels.

    The difference in pose and velocity between end and start is distributed: half of it decays from the start onwards,
    half from the end backwards. If the root is a static reference and the hips below it are translated, the travel of
    the hips is merged into the travel of the root.

    Parameters
    ----------
    take : Take    F frames
    command : CloseLoop    the duration of the blend, and whether to first remove the travel and turn of one cycle,
        evenly over its frames

    Returns
    -------
    Take    F frames

    Raises
    ------
    EditError    if there are fewer than four frames
    MotionError    if the body never has a facing direction
    """
    frames = take.frame_count
    if frames < FEWEST_FRAMES:
        raise EditError(
            f"a loop needs at least {FEWEST_FRAMES} frames, but the clip has {frames}", code="frames-missing"
        )
    places, headings = body_track(take, 0, frames)
    seam = loop_seam(places[:, [0, 2]], headings)
    body, carrier = take.skeleton, take.body.carrier
    stays = root_stands(take.motion, body, carrier)
    motion = body_first(take.motion, body, carrier, root_stays=stays)
    if command.in_place:
        motion = _in_place(motion, places, seam)
        seam = LoopSeam(0.0, np.zeros(2))
    life = 0.5 * frames
    if command.blend_s is not None:
        life = min(life, max(1.0, command.blend_s * take.frame_rate_hz))
    closed = _closed(motion, seam, life, min(life, max(1.0, VELOCITY_S * take.frame_rate_hz)))
    return take.with_motion(root_first(closed, body, carrier, root_stays=stays))


def cut_loop(take: Take, command: CutLoop) -> Take:
    """Replace a periodic motion by one cycle that repeats without a seam.

    Parameters
    ----------
    take : Take    F frames, at least two cycles of 0.6 to 2 s
    command : CutLoop    the metric by which the cycle is found

    Returns
    -------
    Take    the frames of one cycle, with a finding: place of the cycle in the clip, and travel and turn per cycle

    Raises
    ------
    MotionError    if there is no cycle, or the joints that the metric compares are not known
    """
    lags = (cycles.LONGEST_PERIOD_S - cycles.SHORTEST_PERIOD_S) * take.frame_rate_hz
    take.budget.spend(PER_COMPARED_POSES * lags * take.frame_count)
    metric = metric_of(built_in_metric(command.metric))
    measured = measure_motion(take.motion, take.body.matching, take.frame_rate_hz)
    period = cycles.find_period(measured, metric)
    motion, seam = cycles.cut_loop(take.motion, take.body.matching, period)
    values = {
        "frames": [period.start, period.start + period.frames],
        "period_s": period.frames / take.frame_rate_hz,
        "turn_deg": float(np.degrees(seam.turn_rad)),
        "travel_m": float(np.hypot(*seam.shift_m)),
        "metric": command.metric,
    }
    return take.with_motion(motion).with_finding(EditFinding("cut_loop", values))


def _in_place(motion: Motion, places: Floats, seam: LoopSeam) -> Motion:
    """Remove the travel and turn of one cycle, `seam`, evenly over the frames.

    `places` (F, 3) are the positions of the pelvis. Each frame is rotated about the vertical through its pelvis.
    """
    shares = np.arange(motion.frame_count) / motion.frame_count
    start = places[0, [0, 2]]
    travel = rotated(start, seam.turn_rad) + seam.shift_m - start
    shifts = shares[:, None] * -np.array([travel[0], 0.0, travel[1]])
    return carried(motion, about_vertical(-shares * seam.turn_rad), places, shifts)


def _closed(motion: Motion, seam: LoopSeam, life: float, velocity_life: float) -> Motion:
    """Remove the difference in pose and velocity between end and start, half of it at each end of the motion.

    `life` and `velocity_life` are the numbers of frames over which the correction of pose and of velocity decays.
    """
    frames = motion.frame_count
    following = moved_over(motion.sliced(0, 2), seam)
    arrival = step_of(motion, frames - 2)
    going_on = add_offset(motion.sliced(frames - 1, frames), np.array([0]), arrival)
    difference = offset_to(following, 0, going_on, 0).times(0.5)
    velocity = arrival.minus(step_of(following, 0)).times(0.5)
    touched = np.arange(min(frames, int(np.ceil(life))))
    ages = touched.astype(np.float64)
    at_end = decayed_offset(difference.times(-1.0), velocity, ages + 1.0, life, velocity_life)
    motion = add_offset(motion, frames - 1 - touched, at_end)
    at_start = decayed_offset(difference, velocity, ages, life, velocity_life)
    return add_offset(motion, touched, at_start.turned(-seam.turn_rad))

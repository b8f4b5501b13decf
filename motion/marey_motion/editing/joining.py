"""Edit command that appends a clip to a take: `concatenate`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.editing.annotations.contacts import contact_labels
from marey_motion.editing.borders import blended, smooth_step
from marey_motion.editing.foot_plants import Foot
from marey_motion.editing.ground import heights_of_soles
from marey_motion.editing.kept_feet import feet_as_motion, feet_of, with_feet
from marey_motion.editing.limb_smoothing import MOST_STEP, largest_steps
from marey_motion.editing.offsets import VELOCITY_S, add_offset, decayed_offset, seam_offset
from marey_motion.editing.placement import body_track, moved_over
from marey_motion.editing.take import EditFinding, Take, motion_of
from marey_motion.editing.translations import with_equal_joints
from marey_motion.errors import EditError
from marey_motion.importing.checks import rest_pose_jumps
from marey_motion.looping import LoopSeam, loop_seam, rotated
from marey_motion.motion import Motion
from marey_motion.resampling import count_samples, resample_motion
from marey_motion.root_carrier import body_first, root_first, root_stands
from marey_motion.skeleton import SAME_SKELETON_M, Skeleton, same_hierarchy
from marey_schemas.editing.commands import Concatenate

FARTHEST_HELD_M, LONGEST_HELD_S = 0.15, 1.5
"""Limits, in metres and seconds, for feet that are held in place from the seam to the end of their stance.

A foot that is farther than this distance from its place in the second clip would overstretch its leg. A foot whose
stance lasts longer than this time would be in the wrong place for too long.
"""


def concatenate(take: Take, command: Concatenate) -> Take:
    """Append another clip of the same skeleton, resampled to the frame rate of the take.

    A rest pose at the end of the take or at the start of the other clip is left out if the body jumps into or out of
    it. If the root is a static reference and the hips below it are translated, the travel of the hips is merged into
    the travel of the root.

    Parameters
    ----------
    take : Take    F frames
    command : Concatenate    name of the clip to append, its placement, and the blend

    Returns
    -------
    Take    frames of both clips

    Raises
    ------
    EditError    if the source is unknown or has another skeleton, or if the result is too long
    MotionError    if the body has no facing direction at the seam
    """
    take, source, left_out = _without_rest_poses(take, command.source)
    added = _same_rate(take, source)
    first, second = with_equal_joints(take.motion, added.motion, take.skeleton)
    before, after = take.with_motion(first), added.with_motion(second)
    count = take.count_frames(command.blend_s)
    overlap = min(count, before.frame_count, after.frame_count) if command.blend == "slerp" else 0
    if left_out:
        take = take.with_finding(EditFinding("concatenate", left_out))
    if command.blend_s * take.frame_rate_hz > min(before.frame_count, after.frame_count):
        take = take.with_warning(
            "concatenate",
            f"the blend of {command.blend_s:g} s is longer than one of the two clips; choose a shorter blend",
        )
    if command.place == "keep" and count == 0:
        return take.with_motion(_in_a_row(first, second))
    seam = _seam(before, after, overlap) if command.place == "seam" else LoopSeam(0.0, np.zeros(2))
    body, carrier = take.skeleton, take.body.carrier
    stays = all(root_stands(motion, body, carrier) for motion in (first, second))
    first, second = (body_first(motion, body, carrier, root_stays=stays) for motion in (first, second))
    second = moved_over(second, seam)
    joined = _joined(first, second, overlap, count, take.frame_rate_hz)
    first, second, joined = (root_first(motion, body, carrier, root_stays=stays) for motion in (first, second, joined))
    if command.keep_feet and count:
        joined = _with_kept_feet(take, first, second, joined, overlap, count)
    fast = _fastest(take.skeleton, first, second, joined) if count else None
    return take.with_motion(joined) if fast is None else take.with_motion(joined).with_warning("concatenate", fast)


def _fastest(skeleton: Skeleton, first: Motion, second: Motion, joined: Motion) -> str | None:
    """Describe the fastest joint of the joined motion if it moves too far between two frames; otherwise return None.

    A step is too large if it is more than `MOST_STEP` times the largest step of any joint in the two clips.
    """
    before, after, made = (np.asarray(one.positions(skeleton), np.float64) for one in (first, second, joined))
    usual = max(float(largest_steps(one).max()) for one in (before, after))
    steps = np.linalg.norm(np.diff(made, axis=0), axis=-1)
    if not steps.size or steps.max() <= MOST_STEP * usual:
        return None
    frame, joint = (int(index) for index in np.unravel_index(int(np.argmax(steps)), steps.shape))
    return (
        f"{skeleton.joint_names[joint]} moves {100.0 * steps.max():.1f} cm between the frames {frame} and {frame + 1}; "
        f"in both clips, no joint moves more than {100.0 * usual:.1f} cm; use a longer blend_s or another seam"
    )


def _without_rest_poses(take: Take, name: str) -> tuple[Take, Clip, dict[str, int]]:
    """Leave out rest poses at both sides of the seam, such as the T-pose that many captures begin with.

    The body jumps out of such a pose within one frame, so the velocity at the seam would have no meaning. Returns the
    take, the source clip, and the numbers of frames that were left out, by side. Raises `EditError` if the source is
    unknown or has another skeleton.
    """
    clip = take.source(name)
    if not same_hierarchy(clip.skeleton, take.skeleton, tolerance_m=SAME_SKELETON_M):
        raise EditError(
            f"the source clip {name} has a different skeleton from the edited clip; retarget it first",
            code="other-skeleton",
            where="source",
        )
    own = take.motion.as_clip(take.skeleton, take.frame_rate_hz)
    start, end = rest_pose_jumps(clip)[0], rest_pose_jumps(own)[1]
    left_out = {}
    if end:
        left_out["rest_pose_frames_before_seam"] = end
        take = take.with_motion(take.motion.sliced(0, take.frame_count - end))
    if start:
        left_out["rest_pose_frames_after_seam"] = start
        clip = Motion.of(clip).sliced(start, clip.frame_count).as_clip(clip.skeleton, clip.frame_rate_hz)
    return take, clip, left_out


def _same_rate(take: Take, clip: Clip) -> Take:
    """Resample a source clip to the rate of the take. Raises `EditError` if the result is too long."""
    count = count_samples(clip.frame_count, clip.frame_rate_hz, take.frame_rate_hz)
    take.require_room(take.frame_count + count)
    return take.with_motion(resample_motion(motion_of(clip), clip.frame_rate_hz, take.frame_rate_hz))


def _seam(before: Take, after: Take, overlap: int) -> LoopSeam:
    """Compute the rotation about the vertical and the shift on the ground that attach `after` to the end of `before`.

    `overlap` is the number of frames at the end of `before` that are blended with the first frames of `after`. If it
    is not 0, position and heading of the two bodies agree in the middle of the overlap.
    """
    if overlap:
        there, here = before.frame_count - overlap + overlap // 2, overlap // 2
        (target,), (wanted,) = body_track(before, there, there + 1)
        (start,), (heading,) = body_track(after, here, here + 1)
        turn = float(wanted - heading)
        return LoopSeam(turn, target[[0, 2]] - rotated(start[[0, 2]], turn))
    ends, end_headings = body_track(before, max(0, before.frame_count - 2), before.frame_count)
    starts, start_headings = body_track(after, 0, min(2, after.frame_count))
    # A motion of one frame stands still, so its frame is used twice.
    rows = np.stack((starts[0], starts[-1], ends[0], ends[-1]))[:, [0, 2]]
    return loop_seam(rows, np.array([start_headings[0], start_headings[-1], end_headings[0], end_headings[-1]]))


def _joined(first: Motion, second: Motion, overlap: int, count: int, frame_rate_hz: float) -> Motion:
    """Join two motions.

    If `overlap` is not 0, this many frames of both motions are blended. Otherwise, the difference in pose and
    velocity decays over the first `count` frames of the second motion; if `count` is 0, the result is a hard cut.
    """
    if overlap:
        return _faded_over(first, second, overlap)
    return _in_a_row(first, _inertialised(first, second, count, frame_rate_hz) if count else second)


def _with_kept_feet(take: Take, first: Motion, second: Motion, joined: Motion, overlap: int, count: int) -> Motion:
    """Join the paths of the feet like the path of the root, and keep the soles above the lower floor of the two clips.

    Without an overlap, a foot that is planted just before and just after the seam stays in place; with its next step,
    the foot moves to its place in the second clip (see `_with_held_stances`).
    """
    feet = feet_of(take)
    if not feet:
        return joined
    skeleton, rate_hz = take.skeleton, take.frame_rate_hz
    tracks = [feet_as_motion(skeleton, motion, feet) for motion in (first, second)]
    wanted = _joined(tracks[0], tracks[1], overlap, count, rate_hz)
    seam = first.frame_count - overlap
    soles = [heights_of_soles(skeleton, motion, [foot.leg.end for foot in feet]) for motion in (first, second)]
    floors = np.concatenate((soles[0][:seam], np.minimum(soles[1], soles[0][-1])))
    changed = slice(seam, seam + (overlap or count))
    if overlap:
        floors[seam : first.frame_count] = np.minimum(soles[0][seam:], soles[1][:overlap])
    else:
        wanted, longest = _with_held_stances(take, tracks, wanted, feet, count)
        changed = slice(seam, seam + longest)
    return with_feet(take, joined, feet, wanted, floors, changed)


def _with_held_stances(
    take: Take, tracks: Sequence[Motion], wanted: Motion, feet: Sequence[Foot], count: int
) -> tuple[Motion, int]:
    """Keep each foot in place until its stance ends, if the foot is planted just before and just after the seam.

    A foot is not kept in place if it exceeds one of the limits `FARTHEST_HELD_M` and `LONGEST_HELD_S`.

    `tracks` are the paths of the feet in the first and in the second clip. Returns the new paths of the feet, and the
    number of frames after the seam in which the new paths may differ from those of the second clip.
    """
    translations, seam, longest = wanted.translations.copy(), tracks[0].frame_count, count
    for number in range(len(feet)):
        places = [track.translations[:, number] for track in tracks]
        shift = (places[0][-1] - places[1][0]) * (1.0, 0.0, 1.0)
        stance = _common_stance(places, take.frame_rate_hz)
        if not stance or np.linalg.norm(shift) > FARTHEST_HELD_M or stance > LONGEST_HELD_S * take.frame_rate_hz:
            continue
        ages = np.maximum(np.arange(len(places[1]), dtype=np.float64) - stance, 0.0)
        s = np.clip(ages / count, 0.0, 1.0)
        left = np.multiply.outer((1.0 - s) ** 3 * (1.0 + 3.0 * s + 6.0 * s * s), shift)
        translations[seam:, number, ::2] = (places[1] + left)[:, ::2]
        longest = max(longest, stance + count)
    return wanted._replace(translations=translations), longest


def _common_stance(places: Sequence[Floats], rate_hz: float) -> int:
    """Count the frames after the seam in which a foot is planted, if it is also planted just before the seam."""
    standing = [contact_labels(one[:, None], rate_hz)[:, 0] for one in places]
    if not standing[0][-1] or not standing[1][0]:
        return 0
    return int(np.argmin(np.append(standing[1], False)))


def _inertialised(first: Motion, second: Motion, count: int, frame_rate_hz: float) -> Motion:
    """Make the second motion start with the pose and velocity that the first motion has at its end.

    The change decays over the first `count` frames.
    """
    difference, velocity = seam_offset(first, second)
    ages = np.arange(min(count, second.frame_count), dtype=np.float64)
    velocity_life = min(float(count), max(1.0, VELOCITY_S * frame_rate_hz))
    left = decayed_offset(difference, velocity, ages, float(count), velocity_life)
    return add_offset(second, np.arange(len(ages)), left)


def _in_a_row(first: Motion, second: Motion) -> Motion:
    return first._replace(
        root_translations=np.concatenate((first.root_translations, second.root_translations)),
        rotations=np.concatenate((first.rotations, second.rotations)),
        translations=np.concatenate((first.translations, second.translations)),
    )


def _faded_over(first: Motion, second: Motion, overlap: int) -> Motion:
    """Join two motions; the last `overlap` frames of the first fade into the first frames of the second."""
    share = smooth_step(np.arange(1, overlap + 1) / (overlap + 1))
    end, start = slice(first.frame_count - overlap, None), slice(None, overlap)
    middle = first._replace(
        root_translations=first.root_translations[end]
        + share[:, None] * (second.root_translations[start] - first.root_translations[end]),
        rotations=blended(first.rotations[end], second.rotations[start], share),
        translations=first.translations[end]
        + share[:, None, None] * (second.translations[start] - first.translations[end]),
    )
    kept = first.sliced(0, first.frame_count - overlap)
    return _in_a_row(_in_a_row(kept, middle), second.sliced(overlap, second.frame_count))

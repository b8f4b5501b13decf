"""Differences between two clips: their timing, skeletons, rotations, paths and translations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.arrays import CM_PER_M, Floats, Ints
from marey_motion.clip import Clip
from marey_motion.difference.changes import (
    NOISE_CM,
    NOISE_DEG,
    MatchedFrames,
    Move,
    joint_changes,
    path_change,
    whole_move,
)
from marey_motion.difference.poses import Poses, rotation_changes_deg
from marey_motion.difference.skeletons import JointPairs, compare_skeletons, pair_joints
from marey_motion.difference.timing import SAME_PACE, Timing, compare_timing, frame_runs
from marey_motion.kinematics import global_positions
from marey_motion.looping import about_vertical
from marey_schemas.documents.differences import (
    DifferenceOptions,
    DifferencePlot,
    JointChange,
    MotionDifference,
)

STILL_M = 0.001
"""A joint that moves along each axis by at most this distance, in metres, counts as not moving."""
MOST_ROWS = 600
"""Maximum number of rows in the plot of changed rotations."""
MOST_POINTS = 1000
"""Maximum number of points of a plotted path."""
MOST_PLOTTED_JOINTS = 256


def compare_clips(
    before: Clip, after: Clip, options: DifferenceOptions | None = None, *, plot: bool = False
) -> tuple[MotionDifference, DifferencePlot | None]:
    """Describe the differences between two clips.

    Frames are matched by content, so that the frames after a removed or inserted frame do not count as changed. In the
    matched frames, the rotations, paths and translations of the joints that both skeletons have are compared.

    Parameters
    ----------
    before, after : Clip    clips of the same or of different skeletons
    options : DifferenceOptions, optional    thresholds; frames in which a change exceeds its threshold are listed
    plot : bool    whether to compute the data of a plot, too

    Returns
    -------
    difference : MotionDifference    in degrees and centimetres
    plot : DifferencePlot or None    changes of rotations over time, and paths of the body on the ground; None unless
        requested

    Examples
    --------
    >>> from marey_motion import compare_clips, generate_gait
    >>> walk = generate_gait(1.2, 0.0, duration_s=4.0)
    >>> difference, _ = compare_clips(walk, walk.sliced(12, walk.frame_count))
    >>> [(run.change, run.before) for run in difference.runs]
    [('removed', (0, 12)), ('matched', (12, 240))]
    """
    options = options or DifferenceOptions()
    pairing = pair_joints(before.skeleton, after.skeleton)
    carrier = _carrier(before, after, pairing)
    old = _poses(before, pairing.before, pairing.before[carrier])
    new = _poses(after, pairing.after, pairing.after[carrier])
    timing, move = _compare_moved(old, new, after.frame_rate_hz / before.frame_rate_hz)
    pairs = timing.matching.pairs
    matched = MatchedFrames(pairs[:, 1], after.frame_rate_hz)
    names = [after.skeleton.joint_names[joint] for joint in pairing.after]
    rotations = rotation_changes_deg(timing.before, new, pairs)
    translated = _translation_changes(before, after, pairing, timing, matched, options.threshold_cm)
    found = MotionDifference(
        frames=(before.frame_count, after.frame_count),
        frame_rate_hz=(before.frame_rate_hz, after.frame_rate_hz),
        duration_s=(before.duration_s, after.duration_s),
        skeleton=compare_skeletons(before.skeleton, after.skeleton),
        runs=frame_runs(timing, before.frame_count, after.frame_count),
        frames_per_frame=timing.pace.samples_per_frame,
        duration_ratio=_duration_ratio(timing, before, after),
        rotations=joint_changes(names, rotations, matched, threshold=options.threshold_deg, noise=NOISE_DEG),
        path=path_change(names[carrier], *_paths(timing, new, move), matched, options.threshold_cm, move),
        translations=tuple(one for one in translated if carrier == 0 or one.joint != names[carrier]),
        translated_joints=(_translated(before), _translated(after)),
    )
    return found, _plot(names, rotations, pairs, old, new, after.frame_rate_hz) if plot else None


def _carrier(before: Clip, after: Clip, pairing: JointPairs) -> int:
    """Return the index in `pairing.before` and `pairing.after` of the first joint that moves; 0 if no joint moves.

    The path of this joint counts as the path of the body.
    """
    if any(float(np.ptp(clip.root_translations, axis=0).max()) > STILL_M for clip in (before, after)):
        return 0
    for place, joints in enumerate(zip(pairing.before, pairing.after, strict=True)):
        for clip, joint in zip((before, after), joints, strict=True):
            if joint in clip.translated_joints and float(np.ptp(_translations(clip, joint), axis=0).max()) > STILL_M:
                return place
    return 0


def _poses(clip: Clip, joints: tuple[int, ...], carrier: int) -> Poses:
    """Return the poses of a clip: rotations of `joints`, in this order, and positions of `carrier` in the world."""
    whole = joints == tuple(range(clip.skeleton.joint_count))
    positions = clip.root_translations if carrier == 0 else np.ascontiguousarray(global_positions(clip)[:, carrier])
    return Poses(positions, clip.rotations if whole else clip.rotations[:, list(joints)])


def _compare_moved(before: Poses, after: Poses, rate_ratio: float) -> tuple[Timing, Move | None]:
    """Match the frames of two clips. If the whole new clip was moved, move the old clip, too, and match again.

    `rate_ratio` is the frame rate of the new clip divided by that of the old clip. Returns the timing, and the movement
    of the whole clip, None if the clip was not moved.
    """
    timing = compare_timing(before, after, rate_ratio)
    move = whole_move(*_paths(timing, after, None))
    if move is None:
        return timing, None
    rotations = before.rotations.copy()
    turn = about_vertical(np.asarray(move.turn_rad))
    rotations[:, 0] = quaternions.multiply(turn, rotations[:, 0].astype(np.float64))
    moved = Poses(move.applied(before.roots.astype(np.float64)).astype(np.float32), rotations)
    return compare_timing(moved, after, rate_ratio), move


def _paths(timing: Timing, after: Poses, move: Move | None) -> tuple[Floats, Floats]:
    """Return the positions of the body in n matched frames: of the old clip (n, 3), and of the new clip (n, 3).

    If `move` was applied to the old clip, the returned positions of the old clip are those before this movement.
    """
    pairs = timing.matching.pairs
    before = timing.before.roots[pairs[:, 0]].astype(np.float64)
    if move is not None:
        back = Move(-move.turn_rad, np.zeros(3))
        before = back.applied(before - move.shift_m)
    return before, after.roots[pairs[:, 1]].astype(np.float64)


def _duration_ratio(timing: Timing, before: Clip, after: Clip) -> float:
    ratio = timing.pace.samples_per_frame * before.frame_rate_hz / after.frame_rate_hz
    return 1.0 if abs(ratio - 1.0) <= SAME_PACE else ratio


def _translated(clip: Clip) -> tuple[str, ...]:
    return tuple(clip.skeleton.joint_names[joint] for joint in clip.translated_joints)


def _translation_changes(
    before: Clip, after: Clip, joints: JointPairs, timing: Timing, matched: MatchedFrames, threshold_cm: float
) -> tuple[JointChange, ...]:
    """Compare the translations of the joints that at least one of the clips translates.

    If only one of the clips translates a joint, its translation is compared with the joint's offset in the other clip.
    """
    moved = [
        (old, new)
        for old, new in zip(joints.before, joints.after, strict=True)
        if old in before.translated_joints or new in after.translated_joints
    ]
    if not moved or not len(timing.matching.pairs):
        return ()
    places = np.minimum(np.round(timing.pace.places(timing.matching.pairs[:, 0])), before.frame_count - 1).astype(
        np.int64
    )
    steps = [_translations(after, new)[matched.frames] - _translations(before, old)[places] for old, new in moved]
    distances = CM_PER_M * np.linalg.norm(np.stack(steps, axis=1), axis=2)
    names = [after.skeleton.joint_names[new] for _, new in moved]
    return joint_changes(names, distances, matched, threshold=threshold_cm, noise=NOISE_CM)


def _translations(clip: Clip, joint: int) -> NDArray[np.floating]:
    """Return the positions (F, 3) of a joint in its parent's frame."""
    if clip.translations is None or joint not in clip.translated_joints:
        return np.broadcast_to(clip.skeleton.offsets[joint], (clip.frame_count, 3))
    return clip.translations[:, clip.translated_joints.index(joint)]


def _plot(
    names: list[str], rotations: NDArray[np.float32], pairs: Ints, before: Poses, after: Poses, frame_rate_hz: float
) -> DifferencePlot:
    """Make the data of a plot, with at most `MOST_ROWS` rows of changes and `MOST_POINTS` points of each path."""
    largest = rotations.max(axis=0, initial=0.0)
    shown = np.sort(np.argsort(-largest, kind="stable")[:MOST_PLOTTED_JOINTS])
    rows = min(MOST_ROWS, after.frame_count)
    borders = np.arange(rows + 1) * after.frame_count // rows
    degrees = np.full((rows, len(shown)), -1.0, dtype=np.float32)
    np.maximum.at(degrees, np.searchsorted(borders, pairs[:, 1], side="right") - 1, rotations[:, shown])
    return DifferencePlot(
        joints=tuple(names[joint] for joint in shown),
        frame_rate_hz=frame_rate_hz,
        frames=tuple(borders.tolist()),
        rotation_deg=degrees,
        path_before_m=_path(before),
        path_after_m=_path(after),
    )


def _path(poses: Poses) -> NDArray[np.float32]:
    places = np.linspace(0, poses.frame_count - 1, min(MOST_POINTS, poses.frame_count)).astype(np.int64)
    return np.ascontiguousarray(poses.roots[places][:, [0, 2]])

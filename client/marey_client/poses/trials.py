"""Motions that the character displayed in the trials of an evaluation, assembled from frames of recorded clips."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_client.extras import import_optional
from marey_client.handles.clips import ClipHandle
from marey_client.handles.evaluations import EvaluationHandle
from marey_client.poses.pictures import FIGURES_EXTRA
from marey_client.poses.player_pages import ShownMotion, shown_motion
from marey_client.poses.strips import ClipOfStrip, DisplayedFrames, demands_of_trials, mirrored, ranked_trials
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.references import RevisionRef

Floats = NDArray[np.float64]


def motions_of_worst_trials(evaluation: EvaluationHandle, revision: int | None, count: int) -> list[ShownMotion]:
    """Assemble the motions of the worst trials from recorded frames, the worst trial first.

    Each frame is the recorded frame that the character displayed at a tick, moved to the position and the heading of
    the character. The smoothing after switches between clips is left out, so poses jump there. Raises `BadArgument` if
    the evaluation does not rank trials.
    """
    document = evaluation.document(revision=revision)
    ranked = ranked_trials(evaluation, document)
    records = evaluation.records(revision=revision)
    recorded = _RecordedClips(DisplayedFrames(evaluation, document))
    demands = demands_of_trials(document)
    names = [one["trial"] for one in ranked[:count]]
    return [recorded.motion(demands[name], records[name]) for name in names]


class _RecordedClips:
    """Cache of the recorded clips that trials displayed; each clip is read once, as a whole."""

    def __init__(self, shown: DisplayedFrames) -> None:
        self._shown = shown
        self._clips: dict[tuple[str, int, bool], Any] = {}

    def motion(self, name: str, record: dict[str, NDArray[Any]]) -> ShownMotion:
        """Return the motion of a trial, assembled from the trial's record of ticks, under a name for people."""
        places = [self._shown.place(int(row)) for row in record["rows"]]
        clips = [self._whole(one.clip, one.revision, is_mirrored=one.mirrored) for one in places]
        frames = np.array([one.frame for one in places])
        poses = np.stack([clip.poses[frame] for clip, frame in zip(clips, frames, strict=True)])
        translated, translations = _translations(clips, frames)
        shown = import_optional("marey_motion.clip", FIGURES_EXTRA).Clip(
            clips[0].skeleton, self._shown.rate_hz, poses, translations, translated
        )
        moved = _moved(
            shown, np.asarray(record["positions"], dtype=np.float64), np.asarray(record["headings"], dtype=np.float64)
        )
        first = places[0]
        reference = first.clip.motion(frames=slice(0, 1), revision=first.revision).skeleton
        assert isinstance(reference, RevisionRef)
        names = shown.skeleton.joint_names
        motion = MotionDocument(
            skeleton=reference,
            frame_rate_hz=self._shown.rate_hz,
            joints=names,
            poses=moved,
            translations=translations,
            translated_joints=tuple(names[joint] for joint in translated),
        )
        return shown_motion(first.clip, name, motion)

    def _whole(self, clip: ClipHandle, revision: int, *, is_mirrored: bool) -> Any:
        key = (clip.id, revision, is_mirrored)
        if key not in self._clips:
            found = ClipOfStrip(clip, revision).whole()
            self._clips[key] = mirrored(found) if is_mirrored else found
        return self._clips[key]


def _translations(
    clips: Sequence[Any], frames: NDArray[np.int64]
) -> tuple[tuple[int, ...], NDArray[np.float32] | None]:
    """Return the joints that any of the clips translates, and their translations (T, k, 3) in metres.

    Row t is from frame `frames[t]` of `clips[t]`; where this clip does not translate a joint, the joint has its offset.
    """
    joints = np.array(sorted({joint for clip in clips for joint in clip.translated_joints}), dtype=np.int64)
    if not len(joints):
        return (), None
    found = np.stack([clip.skeleton.offsets[joints] for clip in clips]).astype(np.float32)
    for tick, (clip, frame) in enumerate(zip(clips, frames, strict=True)):
        if clip.translations is not None:
            found[tick, np.isin(joints, clip.translated_joints)] = clip.translations[frame]
    return tuple(joints.tolist()), found


def _moved(shown: Any, positions: Floats, headings: Floats) -> NDArray[np.float32]:
    """Return the poses of a clip of T frames, moved: the pelvis to x and z (T, 2) in metres, the body to headings (T,).

    Headings are in radians.
    """
    kinematics = import_optional("marey_motion.kinematics", FIGURES_EXTRA)
    quaternions = import_optional("marey_motion.quaternions", FIGURES_EXTRA)
    body = import_optional("marey_reports.drawing.stick_figures", FIGURES_EXTRA).body_of(shown.skeleton)
    poses: Floats = shown.poses.astype(np.float64)
    points = kinematics.global_positions(shown).astype(np.float64)
    ahead = kinematics.forward_directions(points, *body.facing)
    angles = headings - np.arctan2(ahead[:, 0], ahead[:, 1])
    cos, sin = np.cos(angles), np.sin(angles)
    x, z = (poses[:, :3] - points[:, body.pelvis])[:, (0, 2)].T
    moved = poses.copy()
    moved[:, 0] = positions[:, 0] + cos * x + sin * z
    moved[:, 2] = positions[:, 1] + cos * z - sin * x
    upright = quaternions.from_axis_angle(np.broadcast_to((0.0, 1.0, 0.0), (len(poses), 3)), angles)
    moved[:, 3:7] = quaternions.multiply(upright, poses[:, 3:7])
    return moved.astype(np.float32)

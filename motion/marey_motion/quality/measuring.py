"""Measures of the quality of one clip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.evaluation.coverage import sliding_windows
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.simulation_root import simulation_root
from marey_motion.motion import Motion
from marey_motion.quality import feet as of_feet
from marey_motion.quality.hinges import Hinge, find_hinges, limit_excess_deg
from marey_motion.resampling import resample_motion
from marey_motion.rigs import JointAxes, JointMapping
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.quality import SPEED_EDGES_M_S, TURN_EDGES_DEG_S
from marey_schemas.options.quality import QualityOptions

JERK_FRAMES = 4
"""Least number of frames of a measured clip, because the third derivative needs four frames."""
RATE_TOLERANCE = 0.01
"""Share by which a clip's frame rate may be below the required rate, so that 29.97 Hz is accepted as 30 Hz."""
_NOT_JUDGED = ("finger", "thumb", "hold_point")


@dataclass(frozen=True, eq=False)
class QualityBody:
    """Skeleton, with the joints that are measured.

    Parameters
    ----------
    body : MatchingBody    feet, hips and shoulders
    judged : tuple of int    joints whose jerk is measured: the standard joints without fingers
    hinges : tuple of Hinge    knees and elbows
    """

    body: MatchingBody
    judged: tuple[int, ...]
    hinges: tuple[Hinge, ...]

    @classmethod
    def of(cls, skeleton: Skeleton, mapping: JointMapping, axes: Mapping[str, JointAxes]) -> QualityBody:
        """Find the measured joints by their standard names.

        Parameters
        ----------
        skeleton : Skeleton    J joints
        mapping : JointMapping    its standard joints
        axes : mapping of str to JointAxes    anatomical axes by joint name

        Returns
        -------
        QualityBody    indices of the joints

        Raises
        ------
        MappingError    if feet, hips or shoulders are not mapped; the error names them
        """
        body = MatchingBody.from_mapping(skeleton, mapping)
        names = (name for name in body.standard_joints if not any(part in name for part in _NOT_JUDGED))
        judged = dict.fromkeys(body.standard_joints[name] for name in names)
        return cls(body, tuple(judged), find_hinges(skeleton, mapping, axes))

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about measures that this skeleton does not allow, or allows only in part."""
        said = []
        if self.body.toes == self.body.feet:
            said.append("No toes are mapped, so the ankles are measured in their place.")
        if not self.hinges:
            said.append("No knees and elbows are mapped, so joint limits are not measured.")
        elif any(one.joint == "knee" and one.axis is None for one in self.hinges):
            said.append(
                "The rest pose does not show which way a knee bends, so knees that bend forwards are not found."
            )
        return tuple(said)


@dataclass(frozen=True, eq=False)
class ClipQuality:
    """Quality of a clip.

    Parameters
    ----------
    values : value of each measure of `marey_schemas.documents.quality.MEASURES`; None if it is undefined
    frames : number of measured frames
    speed_seconds, turn_seconds : (bins,) float64    seconds of motion in each bin of speed and of turn rate. Both are
        measured over windows of one second, each of which counts 1 / rate seconds. The sum over the bins is therefore
        about one second less than the clip, and 0 for a clip of one second or less
    """

    values: Mapping[str, float | None]
    frames: int
    speed_seconds: Floats
    turn_seconds: Floats


def measure_quality(
    clip: Clip, body: QualityBody, options: QualityOptions, contacts: NDArray[np.bool_] | None = None
) -> ClipQuality:
    """Measure the quality of a clip.

    Parameters
    ----------
    clip : Clip    F frames
    body : QualityBody    joints of its skeleton
    options : QualityOptions    frame rate, floor and limits
    contacts : (F, 2) bool, optional    labelled contacts of the left and the right foot; None to detect them

    Returns
    -------
    ClipQuality    the measures, after resampling to the rate of the options; penetration and excess of joint limits are
        measured in all frames, without resampling

    Raises
    ------
    MotionError    if the clip has too low a rate or too few frames, or if the body faces no direction
    """
    motion = _at_rate(clip, options.rate_hz)
    skeleton, rate = clip.skeleton, options.rate_hz
    points = _points(clip, motion)
    joints = points[:, : skeleton.joint_count]
    ankles, toes = joints[:, list(body.body.feet)], joints[:, list(body.body.toes)]
    if contacts is not None:
        sampled = np.round(np.arange(motion.frame_count) * max(clip.frame_rate_hz / rate, 1.0)).astype(np.intp)
        contacts = contacts[np.minimum(sampled, clip.frame_count - 1)]
    feet = of_feet.Feet.of(ankles, toes, rate, options, contacts)
    jerks = jerk(joints[:, list(body.judged)], rate)
    depth, excess = _beyond_limits(clip, body, options)
    root = simulation_root(joints, body.body, rate)
    windows = sliding_windows(root.positions, root.headings, rate)
    speeds, turns = windows.speed_m_s, np.degrees(windows.turn_rate_rad_s)
    values = {
        "skate_weighted_m_s": of_feet.weighted_skate(feet, options),
        "skate_height_m_s": of_feet.skate_by_height(feet, options),
        "skate_contact_m_s": of_feet.skate_by_contact(feet),
        "skate_ratio": of_feet.skate_ratio(feet, options),
        "near_floor_share": float(of_feet.near_floor(feet, options).mean()),
        "contact_consistency": of_feet.contact_consistency(feet, options),
        "penetration_m": float(depth.mean()),
        "penetration_max_m": float(depth.max()),
        "jitter_m_s3": float(jerks.mean()),
        "jerk_peak_m_s3": float(jerks.max()),
        "limit_excess_deg": None if excess is None else float(excess.mean()),
        "limit_excess_max_deg": None if excess is None else float(excess.max()),
        "speed_m_s": float(speeds.mean()) if len(speeds) else None,
        "turn_rate_deg_s": float(np.abs(turns).mean()) if len(turns) else None,
    }
    return ClipQuality(
        values,
        motion.frame_count,
        _seconds(speeds, SPEED_EDGES_M_S) / rate,
        _seconds(turns, TURN_EDGES_DEG_S) / rate,
    )


def _beyond_limits(clip: Clip, body: QualityBody, options: QualityOptions) -> tuple[Floats, Floats | None]:
    """Compute, per frame, the depth below the floor (F,) in metres and the excess of joint limits (F,) in degrees.

    The clip is not resampled, because a frame that resampling leaves out might be the worst one. The measures do not
    depend on the frame rate. The excess is None without knees and elbows.
    """
    motion, skeleton = Motion.of(clip), clip.skeleton
    points = _points(clip, motion)
    rotations = np.asarray(kinematics.as_global_rotations(skeleton, motion.rotations), dtype=np.float64)
    excess = limit_excess_deg(body.hinges, points[:, : skeleton.joint_count], rotations, options)
    return np.maximum(-points[..., 1].min(axis=1), 0.0), excess


def jerk(points: Floats, rate_hz: float) -> Floats:
    """Compute the jerk of points: the size of the third difference of their positions over time.

    Parameters
    ----------
    points : (F, k, 3) float64    metres
    rate_hz : float    frames per second

    Returns
    -------
    (F - 3, k) float64    metres per second cubed

    Notes
    -----
    Yi, Zhou and Xu (2021), TransPose, call its mean "jitter".
    """
    return np.asarray(np.linalg.norm(np.diff(points, n=3, axis=0), axis=-1) * rate_hz**3)


def _at_rate(clip: Clip, rate_hz: float) -> Motion:
    if clip.frame_rate_hz < rate_hz * (1.0 - RATE_TOLERANCE):
        raise MotionError(
            f"the clip has {clip.frame_rate_hz:g} frames per second, fewer than the {rate_hz:g} at which clips are "
            f"measured; measure all clips with rate_hz {clip.frame_rate_hz:g} or less",
            code="frame-rate-too-low",
            where="frame_rate_hz",
        )
    motion = resample_motion(Motion.of(clip), clip.frame_rate_hz, min(rate_hz, clip.frame_rate_hz))
    if motion.frame_count < JERK_FRAMES:
        raise MotionError(
            f"the clip has {motion.frame_count} frames at {rate_hz:g} Hz; at least {JERK_FRAMES} are needed",
            code="too-few-frames",
            where="poses",
        )
    return motion


def _points(clip: Clip, motion: Motion) -> Floats:
    """Compute the positions (F, J + E, 3) of joints and end sites in the world, in metres."""
    found = kinematics.forward_kinematics(
        clip.skeleton,
        motion.poses,
        translations=motion.translations,
        translated_joints=motion.translated_joints,
        end_sites=True,
    )
    return np.asarray(found, dtype=np.float64)


def _seconds(values: Floats, edges: tuple[float, ...]) -> Floats:
    """Count values in bins; values beyond the outermost edges are counted in the outermost bins."""
    return np.histogram(np.clip(values, edges[0], edges[-1]), bins=edges)[0].astype(np.float64)

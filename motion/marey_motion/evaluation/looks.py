"""Looks of a trial: the contacts, sliding and sinking of the feet, and the smoothness of the motion.

Everything is measured from the displayed poses, that is after the blending of transitions, and compared with the same
measures of the clips that the trial shows. Values of several clips are averaged by the time for which the trial shows
each of them. Clips that are not shown have no influence, so removing them from the database changes no measure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import AnyFloats, Flags, Floats
from marey_motion.evaluation.held_out import pose_errors
from marey_motion.evaluation.relevance import treading_steps
from marey_motion.evaluation.scenario import Trial
from marey_motion.kinematics import CONTACT_WINDOW_S, forward_kinematics, without_flicker
from marey_motion.looping import rotated
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.display import displayed_points
from marey_motion.matching.record import TrialRecord
from marey_schemas.options.matching import ControllerOptions

LEAST_PATH_M = 1.0
"""Length of a path, in metres, below which contacts per metre are not defined."""
LEAST_SKATE_M_S = 0.01
"""Least sliding speed of the clips' feet, in metres per second, for which a ratio to this speed is defined.

Motion capture does not measure lower speeds accurately.
"""


@dataclass(frozen=True, eq=False)
class ClipLooks:
    """Sums over the rows of each of the C clips of a database; arrays of shape (C,).

    Parameters
    ----------
    rows : number of rows
    standing : number of steps from one row to the next during which a foot is in contact, over both feet
    skated_m_s : sum of the horizontal speeds of the toes during these steps
    standing_rows, heights_m : number of feet in contact, over all rows, and sum of the heights of their toes
    contacts : number of times that a foot comes into contact
    path_m : length of the root's path
    changes_m : sum of the changes of the pose from row to row, as in the pose cost
    """

    rows: Floats
    standing: Floats
    skated_m_s: Floats
    standing_rows: Floats
    heights_m: Floats
    contacts: Floats
    path_m: Floats
    changes_m: Floats


class LooksMeter:
    """Measurement of how the simulated motion of trials looks, in comparison with the clips of one database.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    options : ControllerOptions    options of the trials
    """

    def __init__(self, database: MatchingDatabase, options: ControllerOptions) -> None:
        self._database, self._options = database, options
        self.clips = clip_looks(database)

    def measure(self, trial: Trial, record: TrialRecord, window: Flags) -> dict[str, float | None]:
        """Measure how the simulated motion of a trial looks: feet, steps on the spot, and errors of poses.

        Feet and changes of pose of the displayed clips are measured, too, for comparison; these names end in `_clips`.

        Parameters
        ----------
        trial : Trial    the trial; only poses of trials along takes can have errors
        record : TrialRecord    T simulated ticks
        window : (T - 1,) bool    the steps that count; step k leads from tick k to tick k + 1

        Returns
        -------
        dict of str to float or None    metrics by name; None if a metric is not defined. Errors of poses are contained
            only for trials along takes.
        """
        shown = self._shown(record.rows[1:][window])
        return {
            **self._foot_metrics(record, window, shown),
            "pose_cost_clips": _ratio(shown["changes_m"], shown["rows"]),
            "treading_per_s": _ratio(
                float(np.count_nonzero(treading_steps(self._database.clips, record) & window)) * record.rate_hz,
                float(np.count_nonzero(window)),
            ),
            **pose_errors(self._database, self._options, trial, record, window),
        }

    def _foot_metrics(self, record: TrialRecord, window: Flags, shown: Mapping[str, float]) -> dict[str, float | None]:
        database = self._database
        toes = displayed_points(database, record.rows, database.body.leg_chain, self._options)
        contacts = database.contacts[record.rows]
        speeds = ground_speeds(toes, record.positions, record.headings, record.rate_hz)
        skate = _mean(speeds[standing_steps(contacts) & window[:, None]])
        skate_of_clips = _ratio(shown["skated_m_s"], shown["standing"])
        begun = begun_contacts(without_flicker(contacts, record.rate_hz, CONTACT_WINDOW_S)) & window[:, None]
        path_m = float(np.linalg.norm(np.diff(record.positions, axis=0), axis=1)[window].sum())
        floor = _ratio(shown["heights_m"], shown["standing_rows"])
        depths = None if floor is None else np.maximum(0.0, floor - toes[1:, :, 1].min(axis=1)[window])
        return {
            "foot_skate": skate,
            "foot_skate_clips": skate_of_clips,
            "foot_skate_ratio": _skate_ratio(skate, skate_of_clips),
            "foot_depth_p95": float(np.percentile(depths, 95.0)) if depths is not None and len(depths) else None,
            "contacts_per_m": float(np.count_nonzero(begun)) / path_m if path_m >= LEAST_PATH_M else None,
            "contacts_per_m_clips": _ratio(shown["contacts"], shown["path_m"]),
        }

    def _shown(self, rows: NDArray[np.int32]) -> dict[str, float]:
        """Add up the fields of `ClipLooks` over the clips that `rows` display, each as often as it is displayed."""
        shares = np.bincount(self._database.clip_of_row[rows], minlength=len(self.clips.rows))
        used = np.flatnonzero(shares)
        weights = shares[used] / self.clips.rows[used]
        return {
            field.name: float(np.sum(weights * getattr(self.clips, field.name)[used])) for field in fields(ClipLooks)
        }


def clip_looks(database: MatchingDatabase) -> ClipLooks:
    """Measure contacts, sliding feet and smoothness of the clips of a database, played without transitions.

    Parameters
    ----------
    database : MatchingDatabase    N rows of C clips

    Returns
    -------
    ClipLooks    sums over the rows of each clip
    """
    starts, rate_hz = database.starts, database.options.rate_hz
    toes = _toes_of_rows(database)
    inside = np.diff(database.clip_of_row) == 0
    standing = standing_steps(database.contacts) & inside[:, None]
    speeds = ground_speeds(toes, database.root_positions, database.root_headings, rate_hz)
    path = np.linalg.norm(np.diff(database.root_positions, axis=0), axis=1) * inside
    points = database.pose_points
    changes = np.linalg.norm(np.diff(points, axis=0).astype(np.float64), axis=-1).sum(axis=-1) * inside

    def of_steps(values: AnyFloats | Flags) -> Floats:
        """Add up values of steps (N - 1,), or of both feet at steps (N - 1, 2), by the clip in which a step starts."""
        whole = np.append(values.reshape(len(values), -1).sum(axis=1, dtype=np.float64), 0.0)
        return np.add.reduceat(whole, starts[:-1])

    return ClipLooks(
        rows=np.diff(starts).astype(np.float64),
        standing=of_steps(standing),
        skated_m_s=of_steps(speeds * standing),
        standing_rows=np.add.reduceat(database.contacts.sum(axis=1, dtype=np.float64), starts[:-1]),
        heights_m=np.add.reduceat((toes[..., 1] * database.contacts).sum(axis=1, dtype=np.float64), starts[:-1]),
        contacts=of_steps(begun_contacts(database.contacts) & inside[:, None]),
        path_m=of_steps(path),
        changes_m=of_steps(changes),
    )


def ground_speeds(points: AnyFloats, positions: Floats, headings: Floats, rate_hz: float) -> Floats:
    """Compute the horizontal speeds of points of a character.

    Parameters
    ----------
    points : (T, P, 3) float    positions in the frame of the root, metres
    positions, headings : (T, 2), (T,) float64    place of the root on the ground in metres, and its heading in radians
    rate_hz : float    frames per second

    Returns
    -------
    (T - 1, P) float64    metres per second, from each frame to the next
    """
    placed = rotated(np.asarray(points[..., (0, 2)], dtype=np.float64), headings[:, None]) + positions[:, None]
    speeds: Floats = np.hypot(*np.moveaxis(np.diff(placed, axis=0), -1, 0)) * rate_hz
    return speeds


def standing_steps(contacts: Flags) -> Flags:
    """Mark the steps, each from one frame to the next, during which a foot stays on the ground.

    The foot is in contact at both ends of such a step.

    Parameters
    ----------
    contacts : (T, 2) bool    contacts of both feet

    Returns
    -------
    (T - 1, 2) bool    steps
    """
    return contacts[1:] & contacts[:-1]


def begun_contacts(contacts: Flags) -> Flags:
    """Mark the steps, each from one frame to the next, at whose end a foot comes into contact.

    Parameters
    ----------
    contacts : (T, 2) bool    contacts of both feet

    Returns
    -------
    (T - 1, 2) bool    steps
    """
    return contacts[1:] & ~contacts[:-1]


def _toes_of_rows(database: MatchingDatabase) -> AnyFloats:
    """Compute the toes (N, 2, 3) of each row in the frame of its root, in metres."""
    chain = database.body.leg_chain
    columns = np.concatenate((np.arange(3), (3 + 4 * chain.joints[:, None] + np.arange(4)).ravel()))
    own = np.isin(database.translated_joints, chain.joints)
    translations = None if database.translations is None else database.translations[:, own]
    moved = np.flatnonzero(np.isin(chain.joints, database.translated_joints))
    poses = np.ascontiguousarray(database.poses[:, columns])
    found = forward_kinematics(
        chain.skeleton, poses, translations=translations, translated_joints=tuple(moved.tolist())
    )
    return found[:, chain.ends]


def _skate_ratio(skate: float | None, of_clips: float | None) -> float | None:
    """Divide the sliding speed in a trial by that of the clips; None if the clips' feet hardly slide."""
    return skate / of_clips if skate is not None and of_clips is not None and of_clips >= LEAST_SKATE_M_S else None


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole > 0.0 else None


def _mean(values: Floats) -> float | None:
    return float(np.mean(values)) if len(values) else None

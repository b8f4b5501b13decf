"""Subjects of the figures of a model: the model, its examples, and data for drawing both.

Canonical time is the common time to which the examples were aligned; its N frames are the canonical frames. A strip is
a row of pictures of the body at some of these frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics
from marey_motion.alignment.aligned import AlignedSet
from marey_motion.alignment.signs import consistent_poses
from marey_motion.arrays import Floats
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.search.check import SearchCheck
from marey_motion.modelling.training_report import TrainingReport
from marey_motion.skeleton import Skeleton
from marey_reports.drawing.paper import differing_parts, shortened
from marey_reports.drawing.stick_figures import StickFigure, body_of
from marey_reports.drawing.strips import StripMoments

MOMENTS = 7
SAMPLES = 16
LONGEST_LABEL = 18

FROM_ASIDE_RAD, FROM_AHEAD_RAD = float(np.radians(-50.0)), float(np.radians(-25.0))
"""Viewing directions of strips, in radians about +Y, for motions that travel and for all other motions.

Both directions are from the front right. Motions begin facing +z, so walks go to the right in the picture.
"""

TRAVELS_M = 0.3


@dataclass(frozen=True, eq=False)
class ModelSubject:
    """A model and its examples.

    Parameters
    ----------
    primitive : the model
    examples : aligned examples that it was trained on
    report : quality of the model
    check : accuracy of searches, if it was measured
    seed : seed of the drawn samples
    """

    primitive: MotionPrimitive
    examples: AlignedSet
    report: TrainingReport
    check: SearchCheck | None = None
    seed: int = 0

    @cached_property
    def body(self) -> StickFigure:
        """Lines and points that represent the skeleton."""
        return body_of(self.primitive.skeleton)

    @cached_property
    def names(self) -> list[str]:
        """Names of the examples, without the folders and the first words that all share."""
        return differing_parts([clip.name for clip in self.examples.clips])

    @cached_property
    def poses(self) -> Floats:
        """Poses (m, N, 3 + 4·J) of the examples; quaternions have the same signs as in the model."""
        return consistent_poses(self.examples.poses, self.mean_poses)

    @cached_property
    def latents(self) -> Floats:
        """Latent vectors (m, L) of the examples."""
        return self.primitive.latents_of(self.poses, self.examples.time_functions)

    @cached_property
    def seen_from_rad(self) -> float:
        """Direction from which strips show the body, in radians about +Y; more from the side if the motion travels."""
        way = self.mean_poses[[0, -1], :3]
        return FROM_ASIDE_RAD if np.linalg.norm((way[1] - way[0])[[0, 2]]) > TRAVELS_M else FROM_AHEAD_RAD

    @cached_property
    def samples(self) -> Floats:
        """Latent vectors (n, L) drawn from the model."""
        return self.primitive.sample(SAMPLES, self.seed)

    @cached_property
    def mean_poses(self) -> Floats:
        """Poses (N, 3 + 4·J) of the mean motion."""
        return np.asarray(self.primitive.poses(np.zeros((1, self.primitive.dimensions)))[0], dtype=np.float64)

    def points(self, poses: Floats) -> Floats:
        """Compute positions (..., P, 3), in metres, of all joints and then all end sites in poses (..., 3 + 4·J)."""
        return points_of(self.primitive.skeleton, poses)

    def moments(self) -> tuple[NDArray[np.int64], StripMoments]:
        """Choose `MOMENTS` canonical frames as the columns of strips; return them, ascending, and the columns.

        The frames are evenly spaced, except that keyframes replace the frames nearest to them. Each column is centred
        on the position of the mean motion in the column's frame.
        """
        last = self.primitive.frame_count - 1
        frames = np.unique(np.rint(np.linspace(0, last, MOMENTS)).astype(np.int64))
        labels = [""] * len(frames)
        for label, frame in sorted(self.primitive.keyframes.items(), key=lambda each: each[1]):
            free = [place for place in range(len(frames)) if not labels[place] and frame not in frames[:place]]
            ends = {0: 0, len(frames) - 1: last}
            places = [place for place in free if ends.get(place, frame) == frame]
            if places:
                place = min(places, key=lambda place: abs(int(frames[place]) - frame))
                frames[place], labels[place] = frame, shortened(label, LONGEST_LABEL)
        order = np.argsort(frames, kind="stable")
        frames, labels = frames[order], [labels[place] for place in order]
        middles = self.points(self.mean_poses[frames])[:, self.body.pelvis][:, [0, 2]]
        names = [f"{100 * frame / max(last, 1):.0f} %" for frame in frames]
        return frames, StripMoments(middles, names, labels)


def evenly(count: int, most: int) -> NDArray[np.int64]:
    """Return evenly spaced indices from 0 to `count` - 1, at most `most` of them."""
    return np.unique(np.rint(np.linspace(0, count - 1, min(count, most))).astype(np.int64))


def points_of(skeleton: Skeleton, poses: Floats) -> Floats:
    """Compute positions (..., P, 3), in metres, of all joints and then all end sites in poses (..., 3 + 4·J)."""
    flat = np.ascontiguousarray(poses).reshape(-1, poses.shape[-1])
    points = kinematics.forward_kinematics(skeleton, flat, end_sites=True)
    return np.asarray(points.reshape(*poses.shape[:-1], -1, 3), dtype=np.float64)


def position_table(
    subject: ModelSubject, frames: NDArray[np.int64], rows: Sequence[tuple[str, Floats]]
) -> dict[str, object]:
    """Make columns of a table from positions (T, P, 3) of joints, in metres in canonical coordinates."""
    joints = subject.primitive.skeleton.joint_names
    cells = len(frames) * len(joints)
    places = np.concatenate([points[:, : len(joints)].reshape(-1, 3) for _, points in rows])
    return {
        "row": [name for name, _ in rows for _ in range(cells)],
        "canonical_frame": np.tile(np.repeat(frames, len(joints)), len(rows)),
        "joint": list(joints) * (len(frames) * len(rows)),
        "x_m": places[:, 0],
        "y_m": places[:, 1],
        "z_m": places[:, 2],
    }

"""Figures of the components of a model: motions from two standard deviations below the mean to two above the mean."""

from __future__ import annotations

from typing import Any

import numpy as np

from marey_motion.arrays import Floats
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import REFERENCE
from marey_reports.drawing.strips import StripRow, draw_strips
from marey_reports.models.figures.subjects import ModelSubject, position_table

DEVIATIONS = (-2.0, -1.0, 0.0, 1.0, 2.0)
CELL_IN = (1.2, 1.3)


def draw_mean(subject: ModelSubject) -> Sketch:
    """Draw the mean motion as a strip: the body at several moments of canonical time, and the path of the root."""
    frames, moments = subject.moments()
    points = subject.points(subject.mean_poses[frames])
    duration_s = float(subject.primitive.durations_s(np.zeros((1, subject.primitive.dimensions)))[0])
    row = StripRow("mean", f"{duration_s:.2f} s", points[None], _paths(subject, subject.mean_poses[None]))
    figure = draw_strips(subject.body, [row], moments, subject.seen_from_rad, cell_in=(CELL_IN[0], 1.9))
    caption = (
        f"The mean motion of the model: {duration_s:.2f} s, at {len(frames)} moments of canonical time, seen from the "
        "front right. The line on the floor is the path of the root."
    )
    return Sketch(figure, {"positions": position_table(subject, frames, [("mean", points)])}, caption)


def draw_component(subject: ModelSubject, component: int) -> Sketch:
    """Draw the effect of a spatial component as five strips, with the mean motion in grey behind every figure.

    The motions are two and one standard deviations below the mean, the mean, and one and two above it.
    """
    frames, moments = subject.moments()
    swept = sweep(subject, component)
    points = subject.points(swept[:, frames])
    rows = [
        StripRow(
            written(deviation), "", points[[place]], _paths(subject, swept[[place]]), points[2] if deviation else None
        )
        for place, deviation in enumerate(DEVIATIONS)
    ]
    figure = draw_strips(
        subject.body, rows, moments, subject.seen_from_rad, cell_in=CELL_IN, legend=[("mean motion", REFERENCE)]
    )
    share = float(np.diff(subject.primitive.spatial.energy, prepend=0.0)[component])
    joint, moved_cm = most_moved(subject, points)
    caption = (
        f"Effect of this component ({100 * share:.0f} % of the variance): from two standard deviations of the examples "
        f"below the mean to two above it. {joint} differs most between the two ends, by up to {moved_cm:.0f} cm."
    )
    named = [(written(deviation), points[place]) for place, deviation in enumerate(DEVIATIONS)]
    return Sketch(figure, {"positions": position_table(subject, frames, named)}, caption)


def sweep(subject: ModelSubject, component: int) -> Floats:
    """Compute the poses (5, N, 3 + 4·J) of the motions at -2, -1, 0, 1 and 2 standard deviations of a component."""
    primitive = subject.primitive
    latents = np.zeros((len(DEVIATIONS), primitive.dimensions))
    latents[:, component] = np.array(DEVIATIONS) * np.sqrt(primitive.spatial.variances[component])
    return primitive.poses(latents)


def written(deviation: float) -> str:
    """Format a number of standard deviations as the name of a row."""
    return "mean" if not deviation else f"{'+' if deviation > 0 else '−'}{abs(deviation):g} sd"


def most_moved(subject: ModelSubject, points: Floats) -> tuple[str, float]:
    """Find the joint that differs most between the first and the last motion; return it with the difference in cm.

    `points` (motions, T, P, 3) are positions in metres.
    """
    joints = subject.primitive.skeleton.joint_names
    apart = np.linalg.norm(points[-1] - points[0], axis=-1)[:, : len(joints)].max(axis=0)
    joint = int(np.argmax(apart))
    return joints[joint], 100.0 * float(apart[joint])


def _paths(subject: ModelSubject, poses: Floats) -> Any:
    return subject.points(poses)[:, :, subject.body.pelvis]

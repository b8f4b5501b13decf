"""Figures that compare samples with examples: bodies drawn on top of each other, and paths of hands and feet."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.rigs import map_joints
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import COLOURS, REFERENCE, Place, add_keys, add_panel, new_figure
from marey_reports.drawing.strips import StripRow, draw_strips
from marey_reports.models.figures.subjects import ModelSubject, evenly, position_table
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes


CELL_IN = (1.2, 1.9)
SHOWN = 20
LEAST_REACHING = 200
FRAMES = 40
FOLLOWED = {
    "left wrist": ("left_wrist", COLOURS[0], "-"),
    "right wrist": ("right_wrist", COLOURS[1], "-"),
    "left ankle": ("left_ankle", COLOURS[0], (0, (3.0, 1.2))),
    "right ankle": ("right_ankle", COLOURS[1], (0, (3.0, 1.2))),
}
WIDTH, LEAST_WIDTH, LEAST_HEIGHT, MOST_HEIGHT = 4.2, 2.6, 1.0, 3.2


class Reach(NamedTuple):
    """Region of space that a joint reaches in the examples and in the samples.

    `examples_m` and `samples_m` (3, 2) are the least and the greatest x (left), y (up) and z (forward), in metres.
    """

    joint: str
    examples_m: Floats
    samples_m: Floats


def reach_of(subject: ModelSubject) -> list[Reach]:
    """Compute the 1 % and 99 % quantiles, per axis, of the positions of wrists and ankles in examples and samples."""
    frames = evenly(subject.primitive.frame_count, FRAMES)
    drawn = subject.primitive.sample(max(LEAST_REACHING, len(subject.poses)), subject.seed)
    sets = [subject.points(poses) for poses in (subject.poses[:, frames], subject.primitive.poses(drawn, frames))]
    spans = [np.quantile(points, (0.01, 0.99), axis=(0, 1)).transpose(1, 2, 0) for points in sets]
    return [Reach(name, spans[0][joint], spans[1][joint]) for name, joint in _followed(subject).items()]


def draw_samples(subject: ModelSubject) -> Sketch:
    """Draw examples and samples in the same canonical frames: all examples in one row, all samples in another row."""
    frames, moments = subject.moments()
    chosen = evenly(len(subject.poses), len(subject.samples))
    examples = subject.points(subject.poses[chosen][:, frames])
    samples = subject.points(subject.primitive.poses(subject.samples)[:, frames])
    rows = [
        StripRow("examples", _count(len(chosen), len(subject.poses)), examples, examples[:0, :, 0]),
        StripRow("samples", str(len(samples)), samples, samples[:0, :, 0]),
    ]
    figure = draw_strips(subject.body, rows, moments, subject.seen_from_rad, cell_in=CELL_IN)
    spread = [_spread_cm(subject, points) for points in (examples, samples)]
    caption = (
        f"{counted(len(chosen), 'training example')} above, {counted(len(samples), 'sample')} of the model below, on "
        "top of each other at the same moments of canonical time, seen from the same direction. Where bodies are "
        "closer together in the lower row, samples vary less than the examples; where they are farther apart, more. "
        f"The mean distance of the joints from their mean position is {spread[0]:.0f} cm for the examples, and "
        f"{spread[1]:.0f} cm for the samples."
    )
    named = [(subject.examples.clips[index].uid, points) for index, points in zip(chosen, examples, strict=True)]
    named += [(f"sample {number}", points) for number, points in enumerate(samples)]
    return Sketch(figure, {"positions": position_table(subject, frames, named)}, caption)


def _count(drawn: int, total: int) -> str:
    return str(total) if drawn == total else f"{drawn} of {total}"


def _spread_cm(subject: ModelSubject, points: Floats) -> float:
    """Compute the mean distance in centimetres of the joints in `points` (m, T, P, 3) from their mean position."""
    joints = points[:, :, : subject.primitive.skeleton.joint_count]
    return 100.0 * float(np.linalg.norm(joints - joints.mean(axis=0), axis=-1).mean())


def draw_paths(subject: ModelSubject) -> Sketch:
    """Draw the paths of wrists and ankles, from the side and above, examples on the left and samples on the right."""
    chosen = evenly(len(subject.poses), SHOWN)
    frames = evenly(subject.primitive.frame_count, FRAMES)
    joints = _followed(subject)
    drawn = subject.primitive.poses(subject.primitive.sample(len(chosen), subject.seed), frames)
    sets = {
        name: subject.points(poses)[:, :, list(joints.values())]
        for name, poses in (("examples", subject.poses[chosen][:, frames]), ("samples", drawn))
    }
    everything = np.concatenate([points.reshape(-1, 3) for points in sets.values()])
    middle, reach = _extent(everything)
    scale = float(min(WIDTH / reach[2], MOST_HEIGHT / reach[1], MOST_HEIGHT / reach[0]))
    width = max(LEAST_WIDTH, scale * float(reach[2]))
    heights = [max(LEAST_HEIGHT, scale * float(reach[axis])) for axis in (1, 0)]
    figure = new_figure(2 * width + 1.5, sum(heights) + 1.95)
    for column, (name, points) in enumerate(sets.items()):
        for row, (axis, label) in enumerate(((1, "height (m)"), (0, "to the left (m)"))):
            bottom = 0.95 + (heights[1] + 0.45 if row == 0 else 0.0)
            place = Place(0.7 + column * (width + 0.55), bottom, width, heights[row])
            title, below = (f"{len(points)} {name}", "") if row == 0 else ("", "forward (m)")
            panel = add_panel(figure, place, title=title, x=below, y=label if column == 0 else "")
            _draw_paths(panel, points, list(joints), axis)
            wide, high = 0.5 * width / scale, 0.5 * heights[row] / scale
            panel.set(xlim=(middle[2] - wide, middle[2] + wide), ylim=(middle[axis] - high, middle[axis] + high))
            if (row, column) == (1, 0):
                add_keys(panel, loc="upper left", bbox_to_anchor=(-0.02, -0.48 / heights[1]), ncols=4)
    names = [*(subject.examples.clips[index].uid for index in chosen), *(f"sample {n}" for n in range(len(chosen)))]
    table = _path_table(names, list(joints), frames, np.concatenate(list(sets.values())))
    caption = (
        f"Trajectories of {_listed(list(joints))}, in metres from the start of the root, with the body facing "
        f"forward: {counted(len(chosen), 'training example')} on the left, as many samples on the right; seen from "
        "the side in the upper row, and from above in the lower row. Samples should fill the region of the examples, "
        "and not leave it."
    )
    return Sketch(figure, {"paths": table}, caption)


def _path_table(names: list[str], joints: list[str], frames: NDArray[np.int64], points: Floats) -> dict[str, object]:
    """Make the columns of a table from trajectories of points (motions, T, joints, 3)."""
    ways = points.transpose(0, 2, 1, 3).reshape(-1, 3)
    return {
        "motion": np.repeat(names, len(joints) * len(frames)).tolist(),
        "joint": np.tile(np.repeat(joints, len(frames)), len(names)).tolist(),
        "canonical_frame": np.tile(frames, len(names) * len(joints)),
        "x_m": ways[:, 0],
        "y_m": ways[:, 1],
        "z_m": ways[:, 2],
    }


def _followed(subject: ModelSubject) -> dict[str, int]:
    """Return the indices of the known wrists and ankles by name; if none is known, those of the ends of chains."""
    skeleton = subject.primitive.skeleton
    known = map_joints(skeleton).joints
    named = {name: skeleton.index_of(known[key]) for name, (key, _, _) in FOLLOWED.items() if key in known}
    ends = sorted(set(range(skeleton.joint_count)) - set(skeleton.parents.tolist()))
    return named or {skeleton.joint_names[joint]: joint for joint in ends[: len(FOLLOWED)]}


def _extent(places: Floats) -> tuple[Floats, Floats]:
    """Compute the centre (3,) and the size (3,), with a margin, of the region of a plot that shows positions (n, 3)."""
    low, high = places.min(axis=0), places.max(axis=0)
    return 0.5 * (low + high), np.maximum(1.08 * (high - low), 0.2)


def _draw_paths(panel: Axes, points: Floats, names: list[str], axis: int) -> None:
    """Draw trajectories of points (m, T, joints, 3) over the forward axis."""
    alpha = float(np.clip(2.5 / np.sqrt(len(points)), 0.3, 1.0))
    for place, name in enumerate(names):
        _, colour, style = FOLLOWED.get(name, ("", REFERENCE, "-"))
        for number, way in enumerate(points[:, :, place]):
            label = name if number == 0 else None
            panel.plot(way[:, 2], way[:, axis], color=colour, ls=style, lw=0.9, alpha=alpha, label=label)


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"

"""Figure of an alignment's costs: differences between frames of a clip and of the reference, and the warping path."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.alignment.aligned import AlignedClip, AlignedSet
from marey_motion.alignment.aligning import restore
from marey_motion.alignment.cost import frame_costs
from marey_motion.arrays import Floats
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    DARK,
    LIGHT,
    MORE_IS_WORSE,
    SIDE,
    Place,
    add_colour_bar,
    add_panel,
    differing_parts,
    new_figure,
    shortened,
)
from marey_reports.models.figures.subjects import evenly
from marey_schemas.options.alignment import CostOptions

MOST_CELLS = 200


class CostView(NamedTuple):
    """Costs of the alignment of one clip with the reference.

    Parameters
    ----------
    costs_cm : (n, m) root mean square distance of joints between n frames of the reference and m frames of the clip
    frames : indices of the n frames in the reference, and of the m frames in the clip
    """

    role: str
    clip: AlignedClip
    costs_cm: Floats
    frames: tuple[NDArray[np.int64], NDArray[np.int64]]

    @property
    def along_path_cm(self) -> Floats:
        """Costs (N,) along the warping path, one for each canonical frame."""
        wanted = (np.arange(len(self.clip.time_function)), np.rint(self.clip.time_function))
        cells = [
            np.abs(frames - each[:, None]).argmin(axis=1) for frames, each in zip(self.frames, wanted, strict=True)
        ]
        return np.asarray(self.costs_cm[cells[0], cells[1]], dtype=np.float64)


def draw_alignment_costs(aligned: AlignedSet, options: CostOptions | None = None) -> Sketch | None:
    """Draw the costs of the clips with the median and the highest cost; None if the reference is the only clip."""
    views = [_view(aligned, role, clip, options) for role, clip in _chosen(aligned)]
    if not views:
        return None
    ceiling = max(float(np.quantile(view.costs_cm, 0.98)) for view in views) or 1.0
    figure = new_figure(0.75 + len(views) * (SIDE + 0.85) + 0.35, SIDE + 1.15)
    rate = aligned.frame_rate_hz
    shown = differing_parts([clip.name for clip in aligned.clips])
    names = dict(zip((clip.uid for clip in aligned.clips), shown, strict=True))
    images = []
    for place, view in enumerate(views):
        panel = add_panel(figure, Place(0.75 + place * (SIDE + 0.85), 0.65, SIDE, SIDE), grid=False,
                          title=f"{view.role}: {shortened(names[view.clip.uid], 20)}", x="time in the reference (s)",
                          y="time in the clip (s)")  # fmt: skip
        ends = (float(view.frames[0][-1]) / rate, float(view.frames[1][-1]) / rate)
        images.append(
            panel.imshow(view.costs_cm.T, origin="lower", extent=(0.0, ends[0], 0.0, ends[1]), aspect="auto",
                         cmap=MORE_IS_WORSE, vmin=0.0, vmax=ceiling, interpolation="nearest")
        )  # fmt: skip
        path_s = np.arange(aligned.frame_count) / rate
        for colour, width in ((LIGHT, 3.0), (DARK, 1.3)):
            panel.plot(path_s, view.clip.time_function / rate, color=colour, lw=width)
    place_of_bar = Place(0.75 + len(views) * (SIDE + 0.85) - 0.55, 0.65, 0.12, SIDE)
    add_colour_bar(figure, images[-1], place_of_bar, "distance of poses (cm)")
    parts = [
        f"{view.clip.name}, {view.role} ({100.0 * np.sqrt(view.clip.cost):.1f} cm along its path)" for view in views
    ]
    caption = (
        "Distance between the poses of a clip and of the reference, after the best turn and shift on the floor, for "
        f"every pair of moments; the line is the path of the alignment: {'; '.join(parts)}. In a good alignment, it "
        "follows a light valley, without long horizontal or vertical parts. Clips are rebuilt from their aligned form."
    )
    table = {
        "clip": [view.clip.uid for view in views for _ in range(aligned.frame_count)],
        "reference_frame": np.tile(np.arange(aligned.frame_count), len(views)),
        "clip_frame": np.concatenate([view.clip.time_function for view in views]),
        "distance_cm": np.concatenate([view.along_path_cm for view in views]),
    }
    return Sketch(figure, {"paths": table}, caption)


def _chosen(aligned: AlignedSet) -> list[tuple[str, AlignedClip]]:
    others = sorted(
        (clip for clip in aligned.clips if clip.uid != aligned.reference), key=lambda one: (one.cost, one.uid)
    )
    if not others:
        return []
    typical, worst = others[(len(others) - 1) // 2], others[-1]
    return [("worst", worst)] if typical is worst else [("typical", typical), ("worst", worst)]


def _view(aligned: AlignedSet, role: str, clip: AlignedClip, options: CostOptions | None) -> CostView:
    reference = next(one for one in aligned.clips if one.uid == aligned.reference)
    points, frames = [], []
    for motion in (reference.motion, restore(clip, aligned.skeleton)):
        chosen = evenly(motion.frame_count, MOST_CELLS)
        points.append(motion.at_frames(chosen).positions(aligned.skeleton))
        frames.append(chosen)
    costs = frame_costs(points[0], points[1], options)
    return CostView(role, clip, 100.0 * np.sqrt(np.maximum(costs, 0.0)), (frames[0], frames[1]))

"""Pictures of stored motions, drawn by `marey_reports`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from marey_client.asynchronous.interruption import CallPool
from marey_client.errors import BadArgument
from marey_client.extras import import_optional
from marey_client.poses.arrays import PosedItem, frames_text
from marey_client.poses.kinematics import rig_of

FIGURES_EXTRA = "figures"
MOST_MOMENTS = 24
READS_AT_ONCE = 8


@dataclass(frozen=True)
class MotionPicture:
    """Picture of a motion; notebooks show it."""

    svg: str = field(repr=False)
    title: str

    def _repr_svg_(self) -> str:
        return self.svg

    def save(self, path: str | Path) -> Path:
        """Write the picture to a file, as SVG; return the path."""
        path = Path(path)
        if path.suffix.lower() != ".svg":
            raise BadArgument(f"{path}: the file name of the picture must end in .svg")
        path.write_text(self.svg, encoding="utf-8")
        return path


def draw_poses(clip: PosedItem, frames: slice | None, moments: int) -> MotionPicture:
    """Draw the poses at up to `moments` frames, evenly spaced over the range; only these frames are read."""
    if not 1 <= moments <= MOST_MOMENTS:
        raise BadArgument(f"moments: a picture shows 1 to {MOST_MOMENTS} moments, not {moments}")
    frames_text(frames)
    chosen = range(*(frames or slice(None)).indices(clip.frames))
    if not chosen:
        raise BadArgument(f"frames: {clip.path!r} has {clip.frames} frames; the range contains none of them")
    drawing = import_optional("marey_reports.drawing.strips", FIGURES_EXTRA)
    documents = import_optional("marey_motion.documents", FIGURES_EXTRA)
    skeleton = documents.skeleton_from_document(rig_of(clip).hierarchy)
    picked = [chosen[round(place)] for place in np.linspace(0, len(chosen) - 1, min(moments, len(chosen)))]

    def read(frame: int) -> Any:
        motion = clip.motion(frames=slice(frame, frame + 1), revision=clip.item.revision)
        return documents.clip_from_document(motion, skeleton)

    with CallPool(READS_AT_ONCE, thread_name_prefix="marey-poses") as pool:
        poses = list(pool.map(read, picked))
    svg: str = drawing.draw_clip_strip(poses, picked, clip.frame_rate_hz, title=clip.path)
    return MotionPicture(svg, clip.path)

"""Aligned sets and models of generated gaits: small and exact, with special cases where tests need them."""

from collections.abc import Sequence

import numpy as np

from marey_motion.alignment.aligned import AlignedClip, AlignedSet, Placement
from marey_motion.gait import generate_gait
from marey_motion.motion import Motion

FRAMES = 48


def walks(count: int = 12, *, names: Sequence[str] | None = None, frames: int = FRAMES, seed: int = 0) -> AlignedSet:
    """Return walks of equal duration and increasing speed, played at varying speed."""
    random = np.random.default_rng(seed)
    speeds = np.linspace(0.9, 1.7, count)
    clips, skeletons = [], []
    for index, speed in enumerate(speeds):
        clip = generate_gait(float(speed), float(random.normal(0.0, 0.25)), frames / 60.0)
        skeletons.append(clip.skeleton)
        slopes = np.exp(0.35 * random.normal() + 0.3 * random.normal() * np.sin(np.linspace(0.0, np.pi, frames - 1)))
        times = np.concatenate(([0.0], np.cumsum(slopes)))
        times *= round(times[-1]) / times[-1]
        name = f"walk {index:02d}" if names is None else names[index]
        clips.append(
            AlignedClip(
                uid=f"walk{index:03d}",
                name=name,
                motion=Motion.of(clip),
                time_function=times if index else np.arange(frames, dtype=np.float64),
                placement=Placement(0.0, 0.0, 0.0),
                cost=0.0004 * (index + 1),
                source_frames=round(times[-1]) + 1 if index else frames,
            )
        )
    keyframes = {"left foot down": frames // 3, "right foot down": 2 * frames // 3}
    return AlignedSet(skeletons[-1], 60.0, tuple(clips), "walk000", keyframes)

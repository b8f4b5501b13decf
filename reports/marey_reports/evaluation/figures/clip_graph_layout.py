"""Layout of the graph of clips (`clip_graph`): circles on a ring, so that no line crosses a circle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from marey_motion.arrays import Floats, Ints

SMALLEST, LARGEST = 0.45, 1.0  # radius of a circle; the square root of its frames decides between
BETWEEN = 0.28  # room between circles
OPEN = 0.07  # of a turn is left open above, where a clip begins and ends
MOST_DOTS = 720
FEWEST_DOTS, FULLEST = 12, 72  # dots on one circle


@dataclass(frozen=True, eq=False)
class Circle:
    """Circle of a clip: centre, radius, number of frames, and number of dots; a dot shows a range of frames."""

    centre: Floats
    radius: float
    frames: int
    dots: int

    def dot_of(self, frames: Ints) -> Ints:
        """Find the dot that represents each frame."""
        return np.asarray(np.minimum(frames * self.dots // max(self.frames, 1), self.dots - 1), dtype=np.int64)

    def coarser(self, factor: int) -> Circle:
        """Make the same circle with `factor` times fewer dots."""
        return replace(self, dots=max(1, self.dots // factor))

    @property
    def bounds(self) -> Ints:
        """First frame of each dot, then the number of frames: shape (dots + 1,)."""
        return np.asarray(-(-np.arange(self.dots + 1) * self.frames // self.dots), dtype=np.int64)

    def middle_of(self, dots: Any) -> Any:
        """Return the middle frame of the range that each dot represents."""
        bounds = self.bounds
        return (bounds[dots] + bounds[np.asarray(dots) + 1]) // 2

    def place_of(self, frames: Any) -> Floats:
        """Compute the position (..., 2) of each frame: clockwise from the top."""
        turn = OPEN / 2 + (1.0 - OPEN) * (np.asarray(frames) + 0.5) / max(self.frames, 1)
        return self.centre + self.radius * np.stack((np.sin(2 * np.pi * turn), np.cos(2 * np.pi * turn)), axis=-1)


def arrange(frames: Mapping[str, int], links: Mapping[tuple[str, str], int]) -> dict[str, Circle]:
    """Arrange the circles of clips, and return them by uid; clips with many transitions between them are side by side.

    Parameters
    ----------
    frames : number of frames by uid, the most used clip first
    links : number of transitions from one clip to another, by the uids of both clips
    """
    order = _neighbours(list(frames), links)
    largest = max(frames.values(), default=1)
    radii = np.array([max(SMALLEST, LARGEST * (frames[uid] / largest) ** 0.5) for uid in order])
    dots = _dots([frames[uid] for uid in order])
    return {
        uid: Circle(centre, float(radius), frames[uid], int(count))
        for uid, centre, radius, count in zip(order, _ring(radii), radii, dots, strict=True)
    }


def _neighbours(uids: Sequence[str], links: Mapping[tuple[str, str], int]) -> list[str]:
    """Order clips so that clips with many transitions between them are neighbours.

    The order begins with the first clip. Each next clip is the one with most transitions to or from the previous clip.
    """
    left, order = list(uids), list[str]()
    while left:
        last = order[-1] if order else None
        best = max(left, key=lambda uid: links.get((last, uid), 0) + links.get((uid, last), 0) if last else 0)
        order.append(best)
        left.remove(best)
    return order


def _ring(radii: Floats) -> Floats:
    """Place circles on a ring, clockwise from the top, so that neighbours do not touch; return their centres (n, 2)."""
    if len(radii) < 2:
        return np.zeros((len(radii), 2))
    rooms = radii + BETWEEN / 2
    widths = 2 * np.pi * rooms / rooms.sum()
    angles = np.cumsum(widths) - widths / 2 - widths[0] / 2
    if len(radii) == 2:
        angles = np.array([-0.5, 0.5]) * np.pi
    steps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    needed = (rooms + np.roll(rooms, -1)) / (2.0 * np.sin(np.minimum(steps, np.pi) / 2))
    return np.asarray(needed.max() * np.stack((np.sin(angles), np.cos(angles)), axis=1))


def _dots(frames: Sequence[int]) -> Ints:
    """Compute each clip's number of dots: proportional to the square root of its frame count, at most one per frame."""
    counts = np.asarray(frames, dtype=np.float64)
    earned = np.clip(MOST_DOTS * counts**0.5 / max((counts**0.5).sum(), 1.0), FEWEST_DOTS, FULLEST)
    return np.asarray(np.maximum(1, np.minimum(counts, earned)), dtype=np.int64)

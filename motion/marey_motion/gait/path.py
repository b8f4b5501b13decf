"""Root trajectories with a closed form: arcs travelled at a constant or evenly changing speed.

On the ground a point (x, z) is the complex number z + i·x, so that heading theta is the direction e^(i·theta) and a
left turn, counter-clockwise seen from above, increases theta.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import AnyFloats, Complexes
from marey_motion.errors import MotionError


@dataclass(frozen=True)
class PathSegment:
    """A stretch of constant turn rate and evenly changing speed.

    Parameters
    ----------
    duration_s : seconds, positive
    speed_m_s : speed at the start, metres per second, not negative
    turn_rate_rad_s : change of heading, radians per second; positive turns left
    end_speed_m_s : speed at the end; `speed_m_s` if None
    travel_angle_rad : direction of travel relative to the heading: 0 forward, π/2 to the left, π backward
    """

    duration_s: float
    speed_m_s: float
    turn_rate_rad_s: float = 0.0
    end_speed_m_s: float | None = None
    travel_angle_rad: float = 0.0

    def __post_init__(self) -> None:
        for field in ("duration_s", "speed_m_s", "turn_rate_rad_s", "final_speed_m_s", "travel_angle_rad"):
            value = getattr(self, field)
            if not np.isfinite(value):
                raise MotionError(f"a segment needs finite numbers, not {value}", code="gait-invalid", where=field)
        if self.duration_s <= 0:
            raise MotionError(
                f"the duration of a segment must be positive, not {self.duration_s} s",
                code="gait-invalid",
                where="duration_s",
            )
        if min(self.speed_m_s, self.final_speed_m_s) < 0:
            raise MotionError(
                "a speed cannot be negative; to walk backward, set travel_angle_rad to π",
                code="gait-invalid",
                where="speed_m_s",
            )

    @property
    def final_speed_m_s(self) -> float:
        """Speed at the end of the segment, metres per second."""
        return self.speed_m_s if self.end_speed_m_s is None else self.end_speed_m_s

    @property
    def acceleration_m_s2(self) -> float:
        """Change of speed, metres per second squared."""
        return (self.final_speed_m_s - self.speed_m_s) / self.duration_s


@dataclass(frozen=True)
class RootState:
    """Position and motion of the root at n points in time.

    Parameters
    ----------
    positions : (n,) complex    z + i·x, metres
    velocities : (n,) complex    metres per second
    headings : (n,) float    radians, not wrapped
    turn_rates : (n,) float    radians per second
    travel_angles : (n,) float    direction of travel relative to the heading, radians
    """

    positions: Complexes
    velocities: Complexes
    headings: AnyFloats
    turn_rates: AnyFloats
    travel_angles: AnyFloats

    @property
    def speeds(self) -> AnyFloats:
        """Speeds (n,) in metres per second."""
        return np.abs(self.velocities)


@dataclass(frozen=True)
class RootPath:
    """Path of consecutive segments; at time 0, it starts at the origin and heads along +Z.

    Before time 0, the path continues with the speed and turn rate of its start; after `duration_s`, with the speed and
    turn rate of its end.

    Parameters
    ----------
    segments : tuple of PathSegment    at least one
    """

    segments: tuple[PathSegment, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "segments", tuple(self.segments))
        if not self.segments:
            raise MotionError("a path needs at least one segment", code="gait-invalid", where="segments")

    @property
    def duration_s(self) -> float:
        """Total duration of the segments, in seconds."""
        return float(self.starts_s[-1])

    @cached_property
    def starts_s(self) -> AnyFloats:
        """Start of each of `pieces`, in seconds; 0 for the first piece, which has an end (time 0) but no start."""
        ends = np.cumsum([segment.duration_s for segment in self.segments])
        return np.concatenate(([0.0, 0.0], ends))

    @cached_property
    def pieces(self) -> tuple[PathSegment, ...]:
        """All segments, preceded and followed by an endless piece that continues the path beyond its start and end."""
        first, last = self.segments[0], self.segments[-1]
        before = PathSegment(1.0, first.speed_m_s, first.turn_rate_rad_s, None, first.travel_angle_rad)
        after = PathSegment(1.0, last.final_speed_m_s, last.turn_rate_rad_s, None, last.travel_angle_rad)
        return (before, *self.segments, after)

    def rescaled(self, *, length: float, time: float) -> RootPath:
        """Return a path whose lengths and times are multiplied by factors.

        Parameters
        ----------
        length, time : float    factors

        Returns
        -------
        RootPath    the scaled path
        """
        return RootPath(
            tuple(
                PathSegment(
                    segment.duration_s * time,
                    segment.speed_m_s * length / time,
                    segment.turn_rate_rad_s / time,
                    segment.final_speed_m_s * length / time,
                    segment.travel_angle_rad,
                )
                for segment in self.segments
            )
        )

    def piece_at(self, times_s: AnyFloats) -> NDArray[np.intp]:
        """Find the piece that each time falls into.

        Parameters
        ----------
        times_s : (n,)    seconds

        Returns
        -------
        (n,) int    index into `pieces`
        """
        return np.searchsorted(self.starts_s[1:], times_s, side="right")

    def at(self, times_s: AnyFloats) -> RootState:
        """Compute the exact state of the root.

        Parameters
        ----------
        times_s : (n,)    seconds, of any range

        Returns
        -------
        RootState    at those times
        """
        times_s = np.asarray(times_s, dtype=np.float64)
        piece = self.piece_at(times_s)
        speed, acceleration, turn_rate, travel = self._columns[:, piece]
        elapsed = times_s - self.starts_s[piece]
        start_position, start_heading = self._anchors
        headings = start_heading[piece] + turn_rate * elapsed
        shift = speed * _moment_0(turn_rate, elapsed) + acceleration * _moment_1(turn_rate, elapsed)
        return RootState(
            positions=start_position[piece] + np.exp(1j * (start_heading[piece] + travel)) * shift,
            velocities=(speed + acceleration * elapsed) * np.exp(1j * (headings + travel)),
            headings=headings,
            turn_rates=turn_rate,
            travel_angles=travel,
        )

    @cached_property
    def _columns(self) -> AnyFloats:
        """Table (4, pieces): speed, acceleration, turn rate and travel angle, in metres, seconds and radians."""
        rows = [(p.speed_m_s, p.acceleration_m_s2, p.turn_rate_rad_s, p.travel_angle_rad) for p in self.pieces]
        return np.array(rows).T

    @cached_property
    def _anchors(self) -> tuple[Complexes, AnyFloats]:
        """Position and heading of the root at each time in `starts_s`."""
        positions, headings = [0j, 0j], [0.0, 0.0]
        for segment in self.segments:
            duration, turn_rate = np.array(segment.duration_s), np.array(segment.turn_rate_rad_s)
            shift = segment.speed_m_s * _moment_0(turn_rate, duration)
            shift = shift + segment.acceleration_m_s2 * _moment_1(turn_rate, duration)
            direction = np.exp(1j * (headings[-1] + segment.travel_angle_rad))
            positions.append(complex(positions[-1] + direction * shift))
            headings.append(headings[-1] + segment.turn_rate_rad_s * segment.duration_s)
        return np.array(positions), np.array(headings)


def straight_or_arc(speed_m_s: float, turn_rate_rad_s: float, duration_s: float, **options: float) -> RootPath:
    """Make a path of one segment.

    Parameters
    ----------
    speed_m_s : float    metres per second
    turn_rate_rad_s : float    radians per second, positive to the left
    duration_s : float    seconds
    options : float    further parameters of `PathSegment`

    Returns
    -------
    RootPath    starting at the origin along +Z
    """
    return RootPath((PathSegment(duration_s, speed_m_s, turn_rate_rad_s, **options),))


def start_and_stop(
    speed_m_s: float, *, wait_s: float, ramp_s: float, cruise_s: float, turn_rate_rad_s: float = 0.0
) -> RootPath:
    """Make a path that waits, accelerates evenly, travels at full speed, slows down evenly and waits.

    Parameters
    ----------
    speed_m_s : float    full speed, metres per second
    wait_s, ramp_s, cruise_s : float    seconds of waiting, of each change of speed, and of travel at full speed
    turn_rate_rad_s : float    radians per second during the travel at full speed

    Returns
    -------
    RootPath    starting at the origin along +Z
    """
    return RootPath(
        (
            PathSegment(wait_s, 0.0),
            PathSegment(ramp_s, 0.0, end_speed_m_s=speed_m_s),
            PathSegment(cruise_s, speed_m_s, turn_rate_rad_s),
            PathSegment(ramp_s, speed_m_s, end_speed_m_s=0.0),
            PathSegment(wait_s, 0.0),
        )
    )


def _moment_0(turn_rate: AnyFloats, elapsed: AnyFloats) -> Complexes:
    """Compute ∫ e^(i·turn_rate·s) ds from 0 to `elapsed`."""
    half_angle = 0.5 * turn_rate * elapsed
    return np.asarray(elapsed * np.exp(1j * half_angle) * np.sinc(half_angle / np.pi), dtype=np.complex128)


def _moment_1(turn_rate: AnyFloats, elapsed: AnyFloats) -> Complexes:
    """Compute ∫ s·e^(i·turn_rate·s) ds from 0 to `elapsed`."""
    angle = np.asarray(turn_rate * elapsed)
    # The closed form cancels to nothing for small angles, where the power series converges in a few terms.
    small = np.abs(angle) < 1.0
    series = np.zeros(angle.shape, dtype=np.complex128)
    term = np.ones(angle.shape, dtype=np.complex128)
    safe = np.where(small, angle, 0.0)
    for power in range(20):
        series += term / (power + 2)
        term = term * (1j * safe) / (power + 1)
    divisor = np.where(small, 1.0, angle)
    closed = (np.exp(1j * angle) * (1 - 1j * angle) - 1) / divisor**2
    return np.asarray(elapsed**2 * np.where(small, series, closed), dtype=np.complex128)

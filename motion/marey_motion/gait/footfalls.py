"""Footholds of each foot, and the foot's motion from one foothold to the next.

The position of a foot is the position of its ball, the joint about which the toes turn. While the foot is loaded, the
heel or the ball is a fixed point of the floor: the foot rolls about the heel when it lands with the toes up, is flat,
then rolls about the ball. While the foot is in the air, the ball follows a cubic curve in the frame of the root; at
both ends of the curve it moves with the floor, so the motion has no jumps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import AnyFloats, Complexes
from marey_motion.gait import style as styles
from marey_motion.gait.path import RootPath, RootState
from marey_motion.gait.style import GaitStyle, eased

LANDING_SHARE = 0.18  # share of the stance in which a foot that lands tilted comes down flat
PUSH_OFF_START = 0.50  # share of the stance after which the foot rolls off
EARLY_PEAK = 729.0 / 16.0  # makes s²(1 - s)⁴ reach 1, at a third of the swing, where the heel is highest
ROUNDING_M = 0.05  # greatest height over which the lowest part of a swinging foot changes from heel to ball or toes
STILL_M = 1e-9  # lift below which a foot has not left the floor
SHORT_STEP_M = 0.12  # shorter steps are lifted less; no step, no lift


@dataclass(frozen=True)
class FootShape:
    """Lengths of leg and foot, in metres, from which the steps are computed.

    Parameters
    ----------
    ball_height_m : height of the ball joint above the floor in the rest pose
    heel_length_m : distance from the heel to the ball along the sole
    toe_length_m : distance from the ball to the tip of the toes
    ball_ahead_m : distance of the ball in front of the hip in the rest pose
    half_width_m : distance from the middle of the body to the foot in the rest pose
    hip_height_m : height of the hip above the floor in the rest pose
    """

    ball_height_m: float
    heel_length_m: float
    toe_length_m: float
    ball_ahead_m: float
    half_width_m: float
    hip_height_m: float


@dataclass(frozen=True)
class Cadence:
    """Phase of a gait over time: it grows continuously, by one per stride, at a rate that depends on the speed.

    Parameters
    ----------
    path : RootPath    path of the root
    style : GaitStyle    style of the walker
    """

    path: RootPath
    style: GaitStyle

    @cached_property
    def _pieces(self) -> AnyFloats:
        """Table (4, pieces) of start times, and of phase, stride rate and slope of the stride rate at these times."""
        pieces = self.path.pieces
        turn_rates = np.array([piece.turn_rate_rad_s for piece in pieces])
        travels = np.array([piece.travel_angle_rad for piece in pieces])
        durations = np.array([piece.duration_s for piece in pieces])
        first, last = (
            styles.stride_rate_hz(np.array(speeds), turn_rates, travels) / self.style.stride
            for speeds in ([piece.speed_m_s for piece in pieces], [piece.final_speed_m_s for piece in pieces])
        )
        done = np.cumsum(0.5 * (first + last) * durations)[1:-1] - 0.5 * (first[0] + last[0]) * durations[0]
        return np.array([self.path.starts_s, np.concatenate(([0.0, 0.0], done)), first, (last - first) / durations])

    def phase_at(self, times_s: AnyFloats) -> AnyFloats:
        """Compute the phase at given times.

        Parameters
        ----------
        times_s : (n,)    seconds

        Returns
        -------
        (n,)    strides done since time 0
        """
        start, phase, rate, slope = self._pieces[:, self.path.piece_at(times_s)]
        elapsed = times_s - start
        return np.asarray(phase + rate * elapsed + 0.5 * slope * elapsed**2)

    def time_at(self, phases: AnyFloats) -> AnyFloats:
        """Compute the times of given phases.

        Parameters
        ----------
        phases : (n,)    strides done since time 0

        Returns
        -------
        (n,)    seconds
        """
        piece = np.searchsorted(self._pieces[1, 1:], phases, side="right")
        start, phase, rate, slope = self._pieces[:, piece]
        missing = phases - phase
        # This form of the quadratic's root stays exact where the rate hardly changes.
        return np.asarray(start + 2.0 * missing / (rate + np.sqrt(rate**2 + 2.0 * slope * missing)))


@dataclass(frozen=True)
class FootMotion:
    """Motion of one foot at n points in time.

    Parameters
    ----------
    balls : (n, 3)    position of the ball joint, metres
    yaws, pitches, toe_pitches : (n,)    radians; toes up is positive
    freedom : (n,)    0 while the foot is loaded, rising to 1 in the middle of its swing; the greater it is, the more
        gradually a foot that is out of reach is moved towards the hip
    heel_planted, ball_planted : (n,) bool    True where the heel, or the ball, is fixed on the floor
    """

    balls: AnyFloats
    yaws: AnyFloats
    pitches: AnyFloats
    toe_pitches: AnyFloats
    freedom: AnyFloats
    heel_planted: NDArray[np.bool_]
    ball_planted: NDArray[np.bool_]


class _Foot(NamedTuple):
    """Pose of one foot at n points in time, in stance or in swing.

    Parameters
    ----------
    ground : (n,) complex    ground position of the ball of the foot, z + i·x in metres
    heights : (n,)    height of the ball above its height in the rest pose, metres
    pitches, toe_pitches, yaws : (n,)    angles of the foot, of its toes, and of its heading, in radians; toes up is
        positive
    freedom : (n,)    0 in stance, rising to 1 in the middle of the swing: how gradually a foot that is out of reach is
        moved towards the hip
    """

    ground: Complexes
    heights: AnyFloats
    pitches: AnyFloats
    toe_pitches: AnyFloats
    yaws: AnyFloats
    freedom: AnyFloats


@dataclass(frozen=True)
class Footfalls:
    """The stances (phases of ground contact) of one foot over a stretch of time.

    Parameters
    ----------
    cadence : Cadence    strides over time, along a path
    shape : FootShape    lengths of the foot
    side : int    1 for the left foot, -1 for the right
    span_s : (float, float)    first and last requested time, seconds
    """

    cadence: Cadence
    shape: FootShape
    side: int
    span_s: tuple[float, float]

    @cached_property
    def centre_phases(self) -> AnyFloats:
        """Phase in the middle of each stance: a whole number for the left foot, half a stride more for the right."""
        first, last = self.cadence.phase_at(np.array(self.span_s))
        return np.arange(np.floor(first) - 2.0, np.ceil(last) + 3.0) + (0.0 if self.side > 0 else 0.5)

    @cached_property
    def middles(self) -> RootState:
        """State of the root in the middle of each stance."""
        return self.cadence.path.at(self.cadence.time_at(self.centre_phases))

    @cached_property
    def strikes_s(self) -> AnyFloats:
        """Start of each stance, in seconds."""
        return self.cadence.time_at(self.centre_phases - 0.5 * styles.stance_share(self.middles.speeds))

    @cached_property
    def leaves_s(self) -> AnyFloats:
        """End of each stance, in seconds."""
        return self.cadence.time_at(self.centre_phases + 0.5 * styles.stance_share(self.middles.speeds))

    @cached_property
    def footholds(self) -> Complexes:
        """Position of the ball of the foot in each stance, while the foot is flat, as z + i·x in metres."""
        root, shape, style = self.middles, self.shape, self.cadence.style
        forward = np.cos(root.travel_angles)
        sideways = np.abs(np.sin(root.travel_angles))
        # A rolling foot reaches further back than forward, so its stance is centred a little behind the hip.
        ahead = shape.ball_ahead_m - styles.blended(0.09, 0.05, root.speeds) * eased(root.speeds / 1.4) * forward
        narrowing = styles.blended(1.0 - 0.25 * eased(root.speeds), 0.45, root.speeds)
        rate = styles.stride_rate_hz(root.speeds, root.turn_rates, root.travel_angles) / style.stride
        # Side steps must not cross: half of the way between the feet is a quarter of a stride.
        spread = 0.25 * root.speeds * sideways / rate
        bank = styles.bank_rad(root.speeds, root.turn_rates) * style.lean
        lateral = self.side * (shape.half_width_m * narrowing * style.step_width + spread)
        lateral = lateral - 0.6 * shape.hip_height_m * np.tan(bank)
        return np.asarray(root.positions + np.exp(1j * root.headings) * (ahead + 1j * lateral))

    @cached_property
    def lifts_m(self) -> AnyFloats:
        """Greatest clearance between foot and floor, in metres, in the step after each stance except the last."""
        way = np.abs(np.diff(self.footholds)) + 0.3 * np.abs(np.diff(self.middles.headings))
        highest = styles.clearance_m(0.5 * (self.middles.speeds[1:] + self.middles.speeds[:-1]))
        return np.asarray(self.cadence.style.lift * highest * -np.expm1(-way / SHORT_STEP_M))

    def at(self, times_s: AnyFloats) -> FootMotion:
        """Compute the motion of the foot.

        Parameters
        ----------
        times_s : (n,)    seconds, within the span

        Returns
        -------
        FootMotion    at those times
        """
        stance = np.searchsorted(self.strikes_s, times_s, side="right") - 1
        loaded = times_s < self.leaves_s[stance]
        pairs = zip(self._standing(times_s, stance), self._swinging(times_s, stance), strict=True)
        foot = _Foot(*(np.where(loaded, standing, swinging) for standing, swinging in pairs))
        planted = loaded | (self._lift(stance) < STILL_M)
        return FootMotion(
            balls=np.stack((foot.ground.imag, self.shape.ball_height_m + foot.heights, foot.ground.real), axis=-1),
            yaws=foot.yaws,
            pitches=foot.pitches,
            toe_pitches=foot.toe_pitches,
            freedom=foot.freedom,
            heel_planted=planted & (foot.pitches >= 0.0),
            ball_planted=planted & (foot.pitches <= 0.0),
        )

    @cached_property
    def _landing_pitches(self) -> AnyFloats:
        return styles.landing_pitch_rad(self.middles.speeds, self.middles.travel_angles)

    @cached_property
    def _leaving_pitches(self) -> AnyFloats:
        return styles.leaving_pitch_rad(self.middles.speeds, self.middles.travel_angles)

    @cached_property
    def _leaving_pitch_rates(self) -> AnyFloats:
        """Pitch rate of the foot in radians per second, when it leaves the floor after each stance."""
        return np.asarray(self._leaving_pitches / ((1.0 - PUSH_OFF_START) * (self.leaves_s - self.strikes_s)))

    def _standing(self, times_s: AnyFloats, stance: NDArray[np.intp]) -> _Foot:
        """Compute the pose of the foot on the ground: it rolls about the heel, is flat, and rolls about the ball."""
        share = (times_s - self.strikes_s[stance]) / (self.leaves_s - self.strikes_s)[stance]
        landing = 1.0 - eased(share / LANDING_SHARE)
        pushing = np.clip((share - PUSH_OFF_START) / (1.0 - PUSH_OFF_START), 0.0, 1.0)
        pitches = self._landing_pitches[stance] * landing + self._leaving_pitches[stance] * pushing**2 * (2.0 - pushing)
        return _Foot(
            ground=self._rolled(pitches, stance),
            heights=self.shape.heel_length_m * np.sin(np.maximum(pitches, 0.0)),
            pitches=pitches,
            toe_pitches=np.maximum(pitches, 0.0),
            yaws=self.middles.headings[stance],
            freedom=np.zeros_like(pitches),
        )

    def _rolled(self, pitches: AnyFloats, stance: NDArray[np.intp]) -> Complexes:
        """Compute the ground position of the ball after the foot has rolled about its heel by positive `pitches`."""
        back = self.shape.heel_length_m * (1.0 - np.cos(np.maximum(pitches, 0.0)))
        return np.asarray(self.footholds[stance] - back * np.exp(1j * self.middles.headings[stance]))

    def _lift(self, stance: NDArray[np.intp]) -> AnyFloats:
        return self.lifts_m[np.minimum(stance, len(self.lifts_m) - 1)]

    def _swinging(self, times_s: AnyFloats, stance: NDArray[np.intp]) -> _Foot:
        """Compute the pose of the foot in the air, from the end of `stance` to the beginning of the next stance."""
        following = np.minimum(stance + 1, len(self.strikes_s) - 1)
        duration = self.strikes_s[following] - self.leaves_s[stance]
        share = np.clip((times_s - self.leaves_s[stance]) / np.where(duration > 0.0, duration, 1.0), 0.0, 1.0)
        bump = 16.0 * (share * (1.0 - share)) ** 2
        early = EARLY_PEAK * share**2 * (1.0 - share) ** 4
        pitches = _cubic(
            share,
            self._leaving_pitches[stance],
            self._leaving_pitch_rates[stance] * duration,
            self._landing_pitches[following],
            np.zeros_like(duration),
        )
        turn = self.middles.headings[following] - self.middles.headings[stance]
        lifts = self._lift(stance)
        rounding = np.minimum(lifts, ROUNDING_M) * bump
        # The lowest of heel, ball and toes keeps the clearance; the maximum is smooth wherever the foot is in the air.
        heel_drop = smooth_positive_part(self.shape.heel_length_m * np.sin(pitches), rounding)
        toe_pitches = np.where(pitches > 0.0, pitches, pitches * bump)
        toe_drop = smooth_positive_part(-self.shape.toe_length_m * np.sin(toe_pitches), 0.4 * rounding)
        return _Foot(
            ground=self._swing_ground(times_s, stance, following, share),
            heights=lifts * early + heel_drop + toe_drop,
            pitches=pitches,
            toe_pitches=toe_pitches,
            yaws=self.middles.headings[stance] + turn * eased(share),
            freedom=rounding / ROUNDING_M,
        )

    def _swing_ground(
        self, times_s: AnyFloats, stance: NDArray[np.intp], following: NDArray[np.intp], share: AnyFloats
    ) -> Complexes:
        """Compute the path of the ball over the floor: a cubic in the root's frame from one stance to the next."""
        path = self.cadence.path
        leaving, landing = path.at(self.leaves_s[stance]), path.at(self.strikes_s[following])
        pitches, rates = self._leaving_pitches[stance], self._leaving_pitch_rates[stance]
        rolling = -self.shape.heel_length_m * np.sin(np.maximum(pitches, 0.0)) * rates
        moving = np.asarray(rolling * np.exp(1j * self.middles.headings[stance]), dtype=np.complex128)
        start, start_rate = _seen_from(leaving, self._rolled(pitches, stance), moving)
        end, end_rate = _seen_from(landing, self._rolled(self._landing_pitches[following], following), 0.0 * moving)
        duration = self.strikes_s[following] - self.leaves_s[stance]
        now = path.at(times_s)
        local = _cubic(share, start, start_rate * duration, end, end_rate * duration)
        return np.asarray(now.positions + local * np.exp(1j * now.headings))


def _seen_from(root: RootState, points: Complexes, velocities: Complexes) -> tuple[Complexes, Complexes]:
    """Transform points (n,) on the floor, and their velocities (n,), from the world into the root's moving frame.

    The velocities are relative to that frame: the root's own travel and turning are subtracted.
    """
    to_root = np.exp(-1j * root.headings)
    local = (points - root.positions) * to_root
    return local, (velocities - root.velocities) * to_root - 1j * root.turn_rates * local


def _cubic(share: AnyFloats, start: Any, start_rate: Any, end: Any, end_rate: Any) -> Any:
    """Compute the cubic with the values `start` and `end`, and the rates of change `start_rate` and `end_rate`.

    `share` is the place from 0 (start) to 1 (end); rates are per unit of `share`.
    """
    s, r = share, 1.0 - share
    return (
        r * r * (1.0 + 2.0 * s) * start + r * r * s * start_rate + s * s * (3.0 - 2.0 * s) * end - s * s * r * end_rate
    )


def smooth_positive_part(values: AnyFloats, width: AnyFloats) -> AnyFloats:
    """Compute a smooth approximation of max(values, 0), which rounds its corner at 0 and is nowhere below it.

    Parameters
    ----------
    values : (n,)    any unit
    width : (n,)    width of the rounding, in the same unit

    Returns
    -------
    (n,)    in the same unit
    """
    return np.asarray(0.5 * (values + np.sqrt(values**2 + width**2)))

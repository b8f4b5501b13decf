"""Style of generated gaits: its dependence on the speed, and the differences between walkers.

The curves are fits by eye to typical adult values (Winter, Biomechanics and Motor Control of Human Movement, 2009);
they shape steps and swings and never change the root's path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marey_motion.arrays import AnyFloats
from marey_motion.errors import MotionError

GRAVITY_M_S2 = 9.81
STEERING_RADIUS_M = 0.3  # turning on the spot needs steps like walking at this radius
BANK_LIMIT_RAD = 0.35


@dataclass(frozen=True)
class GaitStyle:
    """Factors that scale features of the neutral gait: 1 keeps a feature unchanged, and 0 removes it.

    `stride` must be above 0. With `bounce`, `lean`, `sway` and `arm_swing` at 0, the upper body moves rigidly with the
    root.

    Parameters
    ----------
    stride : length of strides at a given speed
    step_width : distance between the lines along which the two feet walk
    lift : height of the swinging feet
    bounce : rise, fall and sideways tilt of the pelvis
    lean : forward lean of the trunk and banking into turns
    sway : counter-rotation of the shoulders against the legs
    arm_swing : amplitude of the arms
    wander : amplitude of three slow sine waves that are added to the angles of trunk, head and arms; the neutral gait
        has none, so the default is 0
    wander_phases_rad : phases of the three waves
    """

    stride: float = 1.0
    step_width: float = 1.0
    lift: float = 1.0
    bounce: float = 1.0
    lean: float = 1.0
    sway: float = 1.0
    arm_swing: float = 1.0
    wander: float = 0.0
    wander_phases_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.stride > 0.0:
            raise MotionError(
                f"the factor of strides must be above 0, not {self.stride}", code="gait-invalid", where="stride"
            )

    @classmethod
    def varied(cls, seed: int) -> GaitStyle:
        """Draw the random style of one walker.

        Parameters
        ----------
        seed : int    the same seed gives the same style

        Returns
        -------
        GaitStyle    factors near 1
        """
        generator = np.random.default_rng(seed)
        stride, width, lift, bounce, lean, sway, arms = 1.0 + generator.uniform(-1.0, 1.0, 7) * (
            (0.06, 0.25, 0.3, 0.25, 0.5, 0.3, 0.35)
        )
        phases = generator.uniform(0.0, 2.0 * np.pi, 3)
        return cls(
            stride=float(stride),
            step_width=float(width),
            lift=float(lift),
            bounce=float(bounce),
            lean=float(lean),
            sway=float(sway),
            arm_swing=float(arms),
            wander=1.0,
            wander_phases_rad=(float(phases[0]), float(phases[1]), float(phases[2])),
        )


def eased(x: AnyFloats | float) -> AnyFloats:
    """Compute a smooth step: 0 for x <= 0, 1 for x >= 1, with slope 0 at both ends.

    Parameters
    ----------
    x : (...)    numbers, without unit

    Returns
    -------
    (...)    values from 0 to 1
    """
    x = np.clip(x, 0.0, 1.0)
    result: AnyFloats = np.asarray(x * x * (3.0 - 2.0 * x))
    return result


def running_share(speed_m_s: AnyFloats | float) -> AnyFloats:
    """Compute the share of running at a speed.

    Parameters
    ----------
    speed_m_s : (...)    metres per second

    Returns
    -------
    (...)    0 for a walk, 1 for a run, and in between at speeds at which people change from one to the other
    """
    return eased((np.asarray(speed_m_s) - 1.9) / 0.5)


def blended(walk: AnyFloats | float, run: AnyFloats | float, speed_m_s: AnyFloats | float) -> AnyFloats:
    """Blend the values of a walk and a run by speed.

    Parameters
    ----------
    walk, run : (...)    the values
    speed_m_s : (...)    metres per second

    Returns
    -------
    (...)    in the unit of the values
    """
    share = running_share(speed_m_s)
    result: AnyFloats = np.asarray((1.0 - share) * walk + share * run)
    return result


def stride_rate_hz(speed_m_s: AnyFloats, turn_rate_rad_s: AnyFloats, travel_angle_rad: AnyFloats) -> AnyFloats:
    """Compute the stride rate of a gait.

    Parameters
    ----------
    speed_m_s, turn_rate_rad_s, travel_angle_rad : (n,)    metres per second, radians per second, radians

    Returns
    -------
    (n,)    strides (two steps) per second
    """
    stepping = np.hypot(speed_m_s, STEERING_RADIUS_M * turn_rate_rad_s)
    forward = blended(0.45 + 0.36 * stepping, 1.15 + 0.075 * stepping, stepping)
    shorter = 1.0 + 0.35 * np.abs(np.sin(travel_angle_rad)) + 0.15 * np.maximum(-np.cos(travel_angle_rad), 0.0)
    return np.asarray(forward * shorter)


def stance_share(speed_m_s: AnyFloats) -> AnyFloats:
    """Compute the share of a stride in which a foot is on the floor.

    Parameters
    ----------
    speed_m_s : (n,)    metres per second

    Returns
    -------
    (n,)    0 to 1
    """
    return blended(0.68 - 0.05 * speed_m_s, np.maximum(0.46 - 0.035 * speed_m_s, 0.20), speed_m_s)


def landing_pitch_rad(speed_m_s: AnyFloats, travel_angle_rad: AnyFloats) -> AnyFloats:
    """Compute the pitch of the foot when it lands: heel first going forward, ball first going backward.

    Parameters
    ----------
    speed_m_s, travel_angle_rad : (n,)    metres per second, radians

    Returns
    -------
    (n,)    radians, toes up positive
    """
    along = np.cos(travel_angle_rad)
    size = np.where(along > 0.0, blended(0.33, 0.12, speed_m_s), 0.30)
    return np.asarray(along * size * eased(speed_m_s / 1.2))


def leaving_pitch_rad(speed_m_s: AnyFloats, travel_angle_rad: AnyFloats) -> AnyFloats:
    """Compute the pitch of the foot when its ball (going forward) or its heel (going backward) leaves the floor.

    Parameters
    ----------
    speed_m_s, travel_angle_rad : (n,)    metres per second, radians

    Returns
    -------
    (n,)    radians, toes up positive
    """
    along = np.cos(travel_angle_rad)
    size = np.where(along > 0.0, blended(1.05, 1.15, speed_m_s), 0.15)
    return np.asarray(-along * size * eased(speed_m_s / 1.2))


def clearance_m(speed_m_s: AnyFloats) -> AnyFloats:
    """Compute the height of the sole above the floor in the middle of a long step.

    Parameters
    ----------
    speed_m_s : (n,)    metres per second

    Returns
    -------
    (n,)    metres
    """
    return blended(0.035, 0.04 + 0.045 * speed_m_s, speed_m_s)


def bank_rad(speeds: AnyFloats, turn_rates: AnyFloats) -> AnyFloats:
    """Compute the lean into a turn that balances the centrifugal force, up to a limit.

    Parameters
    ----------
    speeds : (n,)    metres per second
    turn_rates : (n,)    radians per second

    Returns
    -------
    (n,)    radians; positive leans left
    """
    return BANK_LIMIT_RAD * np.tanh(np.arctan(speeds * turn_rates / GRAVITY_M_S2) / BANK_LIMIT_RAD)

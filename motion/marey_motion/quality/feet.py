"""Feet of a clip: foot skate by three published definitions, skate ratio, and consistency of contacts.

Positions are in the world, Y up, in metres. A step is the interval from one frame to the next. The speed in a step is
the distance between the two positions of the point, divided by the interval. The height in a step is the height in its
first frame, unless a function states otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics
from marey_motion.arrays import Floats
from marey_motion.editing.annotations.contacts import contact_labels
from marey_schemas.options.quality import QualityOptions

PLANTED_PERCENTILE = 5.0
"""Percentile of a joint's heights that is used as its height while the foot stands, so that outliers are ignored."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Feet:
    """Ankles and toes over F frames.

    Parameters
    ----------
    points : (F, 4, 3) float64    left and right ankle, left and right toe; metres
    heights : (F, 4) float64    heights above the floor of each point, metres
    labels : (F, 4) bool    whether the point is labelled as in contact with the floor
    rate_hz : float    frames per second
    """

    points: Floats
    heights: Floats
    labels: Mask
    rate_hz: float

    @classmethod
    def of(
        cls, ankles: Floats, toes: Floats, rate_hz: float, options: QualityOptions, contacts: Mask | None = None
    ) -> Feet:
        """Measure the heights of ankles and toes above the floor that `options` selects, and label their contacts.

        Parameters
        ----------
        ankles, toes : (F, 2, 3) float64    left and right, metres
        rate_hz : float    frames per second
        options : QualityOptions    options, of which the floor is used
        contacts : (F, 2) bool, optional    labelled contacts of the left and the right foot; if None, the contacts of
            each point are detected by its speed

        Returns
        -------
        Feet    F frames
        """
        points = np.concatenate((ankles, toes), axis=1)
        heights = points[..., 1]
        if options.floor == "planted":
            heights = heights - np.percentile(heights, PLANTED_PERCENTILE, axis=0)
        labels = contact_labels(points, rate_hz) if contacts is None else np.tile(contacts, 2)
        return cls(points, heights, labels, rate_hz)

    @property
    def speeds(self) -> Floats:
        """Speeds in space (F - 1, 4) of the points in each step, in metres per second."""
        return np.asarray(np.linalg.norm(np.diff(self.points, axis=0), axis=-1) * self.rate_hz)

    @property
    def ground_speeds(self) -> Floats:
        """Horizontal speeds (F - 1, 4) of the points in each step, in metres per second."""
        return np.asarray(np.linalg.norm(np.diff(self.points[..., ::2], axis=0), axis=-1) * self.rate_hz)


_TOES = slice(2, 4)


def weighted_skate(feet: Feet, options: QualityOptions) -> float:
    """Compute foot skate weighted by height.

    Parameters
    ----------
    feet : Feet    at least 2 frames
    options : QualityOptions    options, of which the height H (`weighted_height_m`) is used

    Returns
    -------
    float    metres per second

    Notes
    -----
    s = v (2 - 2^(h / H)), with the horizontal speed v, and the height h limited to [0, H]; mean over steps and toes.
    Zhang, Starke, Komura and Saito (2018), Mode-adaptive neural networks for quadruped motion control, with H = 2.5 cm.
    h is the mean of the heights at both ends of the step, so that a step in which a toe leaves the floor weighs less.
    """
    heights = 0.5 * (feet.heights[:-1, _TOES] + feet.heights[1:, _TOES])
    share = np.clip(heights / options.weighted_height_m, 0.0, 1.0)
    return float(np.mean(feet.ground_speeds[:, _TOES] * (2.0 - 2.0**share)))


def near_floor(feet: Feet, options: QualityOptions) -> Mask:
    """Find the frames in which toes are near the floor.

    Parameters
    ----------
    feet : Feet    F frames
    options : QualityOptions    options, of which `near_height_m` is used

    Returns
    -------
    (F, 2) bool    left and right toe
    """
    return np.asarray(feet.heights[:, _TOES] < options.near_height_m)


def skate_by_height(feet: Feet, options: QualityOptions) -> float | None:
    """Compute the mean speed of toes near the floor.

    Parameters
    ----------
    feet : Feet    at least 2 frames
    options : QualityOptions    the height below which a toe is near the floor

    Returns
    -------
    float or None    metres per second; None if no toe is near the floor

    Notes
    -----
    As `FootSkateFromHeight` of the Kimodo benchmark (NVIDIA, 2026): the mean of the speeds in space over all steps of
    both toes that begin near the floor.
    """
    near = near_floor(feet, options)[:-1]
    return float(feet.speeds[:, _TOES][near].mean()) if near.any() else None


def skate_by_contact(feet: Feet) -> float | None:
    """Compute the mean speed of ankles and toes that are labelled as in contact.

    Parameters
    ----------
    feet : Feet    at least 2 frames

    Returns
    -------
    float or None    metres per second; None if nothing is labelled

    Notes
    -----
    As `FootSkateFromContacts` of the Kimodo benchmark (NVIDIA, 2026), where a network predicts the labels.
    """
    labelled = feet.labels[:-1]
    return float(feet.speeds[labelled].mean()) if labelled.any() else None


def skate_ratio(feet: Feet, options: QualityOptions) -> float | None:
    """Compute the skate ratio: how often a toe near the floor moves faster than allowed.

    Parameters
    ----------
    feet : Feet    at least 2 frames
    options : QualityOptions    limits of height and speed

    Returns
    -------
    float or None    share of such pairs of frames, 0 to 1; None if no toe is near the floor in two successive frames

    Notes
    -----
    As `FootSkateRatio` of the Kimodo benchmark (NVIDIA, 2026): a toe must be near the floor in both frames.
    Karunratanakul et al. (2023), Guided motion diffusion, divide by all pairs of frames instead.
    """
    near = near_floor(feet, options)
    both = near[:-1] & near[1:]
    skating = feet.speeds[:, _TOES] > options.skate_speed_m_s
    return float(skating[both].mean()) if both.any() else None


def contact_consistency(feet: Feet, options: QualityOptions) -> float:
    """Compute the share of labels of contact that agree with contacts determined by height and speed.

    Parameters
    ----------
    feet : Feet    at least 2 frames
    options : QualityOptions    limits of height and speed

    Returns
    -------
    float    0 to 1

    Notes
    -----
    As `FootContactConsistency` of the Kimodo benchmark (NVIDIA, 2026), over ankles and toes.
    """
    speeds = np.linalg.norm(kinematics.velocities(feet.points, feet.rate_hz), axis=-1)
    found = (speeds < options.contact_speed_m_s) & (feet.heights < options.contact_height_m)
    return float(np.mean(found == feet.labels))

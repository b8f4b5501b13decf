"""Models to search: an arm whose positions have a closed form, and generated walks."""

from functools import cache

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.gait import generate_gait
from marey_motion.modelling.mixture import LatentMixture
from marey_motion.modelling.primitive import FunctionalComponents, MotionPrimitive
from marey_motion.modelling.splines import SplineBasis, coefficient_count
from marey_motion.motion import Motion
from marey_motion.rigs import map_joints
from marey_motion.skeleton import Skeleton

FRAMES = 31
RATE_HZ = 30.0


def functions(basis: SplineBasis, examples: Floats, count: int) -> tuple[FunctionalComponents, Floats]:
    """Return the principal functions of examples (m, N, D), scaled to scores of unit variance, and these scores."""
    coefficients = basis.fit(examples)
    mean = coefficients.mean(axis=0)
    flat = (coefficients - mean).reshape(len(examples), -1)
    left, deviations, right = np.linalg.svd(flat, full_matrices=False)
    count = min(count, len(deviations))
    spread = deviations / np.sqrt(len(examples))
    shape = (count, *mean.shape)
    components = FunctionalComponents(
        basis=basis,
        mean=mean,
        directions=(right * spread[:, None])[:count].reshape(shape),
        projections=(right / spread[:, None])[:count].reshape(shape),
        variances=np.ones(count),
        energy=(np.cumsum(deviations**2) / (deviations**2).sum())[:count],
    )
    return components, (left * np.sqrt(len(examples)))[:, :count]


def walk_poses(speed_m_s: float, turn_rate_rad_s: float) -> tuple[Skeleton, Floats]:
    """Return the skeleton and the poses of a generated walk of FRAMES frames, with quaternions continuous in sign."""
    clip = generate_gait(speed_m_s, turn_rate_rad_s, FRAMES / RATE_HZ + 0.5, RATE_HZ)
    return clip.skeleton, Motion.of(clip).poses[:FRAMES]


@cache
def walking(components: int = 6, mixtures: int = 2) -> tuple[MotionPrimitive, Floats]:
    """Return a model of walks that differ in speed and turn rate, and the latent vectors (m, L) of the examples."""
    rng = np.random.default_rng(5)
    speeds, turns = rng.uniform(0.8, 1.6, 40), rng.uniform(-0.6, 0.6, 40)
    made = [walk_poses(speed, turn) for speed, turn in zip(speeds, turns, strict=True)]
    skeleton, poses = made[0][0], np.stack([one for _, one in made])
    slopes = np.log(1.3 / speeds)[:, None] + 0.05 * rng.normal(size=(40, 1)) * np.linspace(-1, 1, FRAMES - 1)
    spatial, scores = functions(SplineBasis.clamped(FRAMES, coefficient_count(FRAMES)), poses, components)
    temporal, times = functions(SplineBasis.clamped(FRAMES - 1, 8), slopes[..., None], 2)
    latents = np.concatenate((scores, times), axis=1)
    primitive = MotionPrimitive(
        name="walk",
        skeleton=skeleton,
        frame_rate_hz=RATE_HZ,
        spatial=spatial,
        temporal=temporal,
        temporal_weight=1.0,
        mixture=mixture_of(latents, mixtures),
        keyframes={"middle": FRAMES // 2},
    )
    return primitive, latents


def mixture_of(latents: Floats, count: int) -> LatentMixture:
    """Return a mixture of `count` Gaussians, one for each group of latent vectors with similar first components."""
    parts = np.array_split(latents[np.argsort(latents[:, 0], kind="stable")], count)
    floor = 0.05 * np.eye(latents.shape[1])
    return LatentMixture(
        np.array([len(part) / len(latents) for part in parts]),
        np.stack([part.mean(axis=0) for part in parts]),
        np.stack([np.cov(part.T) + floor for part in parts]),
    )


@cache
def standard_joints() -> dict[str, int]:
    """Return the joint index by standard name, for the skeleton of the walks."""
    skeleton = walking()[0].skeleton
    return {name: skeleton.index_of(joint) for name, joint in map_joints(skeleton).joints.items()}


def sliding(dimensions: int = 2, frames: int = 9, rate_hz: float = 30.0) -> MotionPrimitive:
    """Return a model of a single joint that slides: each score moves it along one axis.

    The mixture has one Gaussian.
    """
    skeleton = Skeleton(("root",), np.array([-1]), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    basis = SplineBasis.clamped(frames, 5)
    mean = np.zeros((5, 7))
    mean[:, 3] = 1.0
    directions = np.zeros((dimensions, 5, 7))
    for axis in range(dimensions):
        directions[axis, :, axis] = 0.1 * (axis + 1)
    spatial = FunctionalComponents(
        basis,
        mean,
        directions,
        directions / (directions**2).sum(axis=(1, 2))[:, None, None],
        np.ones(dimensions),
        np.ones(dimensions),
    )
    slow = SplineBasis.clamped(frames - 1, 4)
    temporal = FunctionalComponents(
        slow, np.zeros((4, 1)), np.zeros((0, 4, 1)), np.zeros((0, 4, 1)), np.zeros(0), np.zeros(0)
    )
    rng = np.random.default_rng(3)
    root = rng.normal(size=(dimensions, dimensions))
    covariance = root @ root.T + np.eye(dimensions)
    mixture = LatentMixture(np.ones(1), rng.normal(size=(1, dimensions)), covariance[None])
    return MotionPrimitive("slide", skeleton, rate_hz, spatial, temporal, 1.0, mixture, {"middle": frames // 2})

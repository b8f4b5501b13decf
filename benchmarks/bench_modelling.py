"""Principal functions, mixtures and whole models, compared with scikit-fda, numpy, scikit-learn and published times."""

from __future__ import annotations

import numpy as np
import skfda
from numpy.typing import NDArray
from skfda.preprocessing.dim_reduction import FPCA
from skfda.representation.basis import BSplineBasis
from sklearn.mixture import GaussianMixture

from benchmarks.timing import Row, Timing, time_in_turn
from marey_motion.alignment.aligning import SourceExample, align_clips
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.modelling.fpca import Keep, find_components
from marey_motion.modelling.mixture_fitting import fit_mixture, one_thread
from marey_motion.modelling.splines import SplineBasis
from marey_motion.modelling.training import train_primitive
from marey_motion.rigs import map_joints
from marey_schemas.options.alignment import AlignOptions
from marey_schemas.options.modelling import ModelOptions

Floats = NDArray[np.float64]

CLIPS, FRAMES, CHANNELS, COEFFICIENTS, COMPONENTS = 100, 150, 255, 30, 20
PUBLISHED_S = 12.7 + 0.26 + 0.50
"""Published time in seconds for 30 clips, on two similar cores: sum of alignment, components and mixtures."""

GOAL_S = 0.5
WITHOUT_REPORT = ModelOptions(leave_one_out=False, folds=0, report_samples=0)


def run() -> list[Row]:
    """Run all measurements of this module on one thread. Other libraries must find the same shares of variance."""
    with one_thread():
        return [_one_channel(), _all_channels(), _mixtures(), _whole_model(), _report()]


def _one_channel() -> Row:
    basis = SplineBasis.clamped(FRAMES, COEFFICIENTS)
    values = _smooth(1)
    theirs = BSplineBasis((0.0, FRAMES - 1.0), n_basis=COEFFICIENTS, order=4)
    data = skfda.FDataGrid(values[..., 0], np.arange(FRAMES, dtype=float))

    def ours() -> Floats:
        found = find_components(basis, basis.fit(values), np.ones(1), Keep(count=COMPONENTS), "l2")
        return found.functions.variances

    def peer() -> Floats:
        return np.asarray(FPCA(n_components=COMPONENTS).fit(data.to_basis(theirs)).explained_variance_)

    np.testing.assert_allclose(ours(), peer(), rtol=1e-6)
    own, other = time_in_turn(ours, peer)
    ratio = other.median_s / own.median_s
    return Row(
        "splines and principal functions, one channel",
        f"{CLIPS} clips of {FRAMES} frames, {COMPONENTS} components",
        _ms(own),
        f"scikit-fda {_ms(other)}",
        ratio,
        "≥ 1x",
        ratio >= 1.0,
    )


def _all_channels() -> Row:
    basis = SplineBasis.clamped(FRAMES, COEFFICIENTS)
    coefficients = basis.fit(_smooth(CHANNELS))

    def ours() -> Floats:
        found = find_components(basis, coefficients, np.ones(CHANNELS), Keep(count=COMPONENTS))
        return found.functions.variances

    def peer() -> Floats:
        flat = coefficients.reshape(CLIPS, -1)
        _, deviations, _ = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
        return np.asarray(deviations[:COMPONENTS] ** 2 / (CLIPS - 1))

    np.testing.assert_allclose(ours(), peer(), rtol=1e-6)
    own, other = time_in_turn(ours, peer)
    return Row(
        "principal functions of all channels",
        f"{CLIPS} x {COEFFICIENTS * CHANNELS:,} coefficients",
        _ms(own),
        f"numpy svd {_ms(other)}",
        other.median_s / own.median_s,
    )


def _mixtures() -> Row:
    random = np.random.default_rng(0)
    points = np.concatenate([random.normal(4.0 * random.standard_normal(4), 1.0, (60, 4)) for _ in range(3)])

    def peer() -> int:
        sweep = [GaussianMixture(count, n_init=5, random_state=0).fit(points) for count in range(1, 11)]
        return len(min(sweep, key=lambda one: one.bic(points)).weights_)

    own, other = time_in_turn(lambda: fit_mixture(points), peer, repeats=5)
    return Row(
        "mixtures of 1 to 10 components, held-out likelihood included",
        "180 examples in 4 dimensions, 5 starts",
        _ms(own),
        f"scikit-learn without it {_ms(other)}",
        other.median_s / own.median_s,
    )


def _whole_model() -> Row:
    examples, body = _examples(30)
    options = AlignOptions(reference=examples[0].uid)
    (ours,) = time_in_turn(lambda: train_primitive(align_clips(examples, body, options), WITHOUT_REPORT), repeats=5)
    return Row(
        "alignment, principal functions, mixture",
        f"30 clips of 42 to 53 frames, {body.skeleton.joint_count} joints",
        _ms(ours),
        f"published system {PUBLISHED_S * 1e3:,.0f} (stated, 78 joints)",
        PUBLISHED_S / ours.median_s,
        f"≤ {GOAL_S * 1e3:.0f} ms",
        ours.median_s <= GOAL_S,
    )


def _report() -> Row:
    examples, body = _examples(200)
    aligned = align_clips(examples, body, AlignOptions(reference=examples[0].uid))
    (ours,) = time_in_turn(lambda: train_primitive(aligned), repeats=3)
    return Row(
        "training with its report, every example left out once",
        f"200 clips of {aligned.frame_count} frames, {body.skeleton.joint_count} joints",
        _ms(ours),
    )


def _smooth(channels: int) -> Floats:
    """Return random smooth functions (clips, frames, channels) with a little noise."""
    random = np.random.default_rng(1)
    basis = SplineBasis.clamped(FRAMES, COEFFICIENTS)
    modes = random.standard_normal((40, COEFFICIENTS, channels)) * np.geomspace(1.0, 0.02, 40)[:, None, None]
    values = basis.at_frames @ np.tensordot(random.standard_normal((CLIPS, 40)), modes, axes=1)
    return np.asarray(values + 1e-3 * random.standard_normal(values.shape))


def _examples(count: int) -> tuple[list[SourceExample], MatchingBody]:
    """Return generated walks of many speeds and turn rates, 42 to 53 frames long, and the walker's body."""
    random = np.random.default_rng(5)
    examples = []
    for number in range(count):
        frames = int(random.integers(42, 54))
        clip = generate_gait(random.uniform(0.9, 1.7), random.normal(0.0, 0.3), frames / 60.0)
        examples.append(SourceExample(f"clip_{number:03d}@1", f"walk {number}", clip))
    skeleton = examples[0].clip.skeleton
    return examples, MatchingBody.from_mapping(skeleton, map_joints(skeleton))


def _ms(timing: Timing) -> str:
    return timing.shown(1e3, "ms")

"""Training of motion primitives from aligned examples, and the report of the training."""

import dataclasses
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.stats import multivariate_normal
from tests.support.modelling_examples import aligned_set, bending_chains, chain, unit_poses, walks, warps
from tests.support.present import present
from tests.support.tiers import is_soak

from marey_motion.alignment.aligned import AlignedClip, AlignedSet, Recording
from marey_motion.alignment.aligning import MIRRORED
from marey_motion.alignment.signs import consistent_poses
from marey_motion.arrays import Flags, Floats
from marey_motion.errors import MotionError
from marey_motion.kinematics import forward_kinematics
from marey_motion.modelling import reconstruction_kernels, training
from marey_motion.modelling.example_groups import ExampleGroups
from marey_motion.modelling.fpca import Keep, find_components
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.primitive_documents import trained_to_tree
from marey_motion.modelling.reconstruction import comparison_frames, reconstruction_errors
from marey_motion.modelling.sample_quality import FootQuality
from marey_motion.modelling.splines import SplineBasis
from marey_motion.modelling.training import TrainedPrimitive, fit_examples, train_primitive
from marey_motion.modelling.training_warnings import warnings_of
from marey_motion.modelling.verdict import headline_of, verdict_of
from marey_motion.skeleton import Skeleton
from marey_schemas.encoding.codecs import MSGPACK, encode_tree
from marey_schemas.options.modelling import ModelOptions, Scaling

SCALINGS: list[Scaling] = ["jacobian", "root_max", "sfpca", "none"]
QUICK = ModelOptions(leave_one_out=False, folds=0, report_samples=0)


def as_bytes(trained: TrainedPrimitive) -> bytes:
    return encode_tree(trained_to_tree(trained, {"item": "skeleton", "revision": 1}, {}), MSGPACK)


# -- the model ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scaling", SCALINGS)
def test_examples_come_back_from_their_latent_vectors(scaling: str) -> None:
    aligned = bending_chains(size=0.02)
    options = QUICK.replace(scaling=scaling, spatial_components=20, temporal_share=1.0)
    primitive = train_primitive(aligned, options).primitive
    latents = primitive.latents_of(aligned.poses, aligned.time_functions)
    poses = primitive.poses(latents)
    reached = [forward_kinematics(aligned.skeleton, one) for one in poses]
    wanted = [forward_kinematics(aligned.skeleton, one) for one in aligned.poses]
    np.testing.assert_allclose(reached, wanted, atol=5e-3)
    np.testing.assert_allclose(primitive.latents_of(poses, primitive.time_functions(latents)), latents, atol=0.02)


def test_only_the_scaling_sfpca_optimises_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    optimised: list[Scaling] = []
    for scaling in SCALINGS:

        def record(skeleton: Skeleton, *arguments: Any, scaling: Scaling = scaling) -> tuple[Floats, Keep]:
            optimised.append(scaling)
            return np.ones(3 + 4 * skeleton.joint_count), Keep(share=0.95)

        monkeypatch.setattr(training, "optimised_weights", record)
        fit_examples(bending_chains(size=0.02), QUICK.replace(scaling=scaling))
    assert optimised == ["sfpca"]


@pytest.mark.parametrize("copies", [1, 5])
def test_copies_of_one_clip_give_that_clip(copies: int) -> None:
    poses = np.repeat(bending_chains(1).poses, copies, axis=0)
    times = np.repeat(warps(1, 30), copies, axis=0)
    trained = train_primitive(aligned_set(chain(), poses, times))
    primitive = trained.primitive
    assert (primitive.spatial.count, primitive.temporal.count) == (0, 0)
    drawn = primitive.sample(3, 1)
    np.testing.assert_allclose(primitive.poses(drawn), np.repeat(poses[:1], 3, axis=0), atol=2e-3)
    np.testing.assert_allclose(primitive.durations_s(drawn), times[0, -1] / 60.0, rtol=1e-9)
    assert [warning.code for warning in trained.warnings] == ["no-variation"]


@pytest.mark.parametrize("copies", [1, 5])
def test_copies_of_what_a_cubic_spline_can_hold_come_back_to_the_last_digits(copies: int) -> None:
    turned = np.random.default_rng(1).standard_normal((4, 4))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    t = np.linspace(0.0, 1.0, 30)
    poses = np.concatenate((np.stack((t, t**2, t**3), axis=1), np.tile(turned.ravel(), (30, 1))), axis=1)
    times = np.repeat(warps(1, 30), copies, axis=0)
    primitive = train_primitive(aligned_set(chain(), np.stack([poses] * copies), times), QUICK).primitive
    for drawn in primitive.poses(primitive.sample(3, 1)):
        np.testing.assert_allclose(drawn, poses, rtol=0, atol=1e-9)


def test_every_sampled_quaternion_has_unit_length() -> None:
    primitive = train_primitive(walks(), QUICK).primitive
    poses = primitive.poses(primitive.sample(50, 2))
    lengths = np.linalg.norm(poses[..., 3:].reshape(*poses.shape[:2], -1, 4), axis=-1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-12)
    for motion in primitive.motions(primitive.sample(3, 2)):
        np.testing.assert_allclose(np.linalg.norm(motion.rotations, axis=2), 1.0, atol=1e-12)


def test_whatever_is_drawn_time_runs_forward() -> None:
    primitive = train_primitive(bending_chains(), QUICK).primitive
    extreme = 6.0 * primitive.mixture.sample(200, 0)
    assert (np.diff(primitive.time_functions(extreme), axis=1) > 0.0).all()


def test_samples_hold_no_frame_longer_or_shorter_than_the_examples_did() -> None:
    aligned = bending_chains(30)
    primitive = train_primitive(aligned, QUICK).primitive
    given = np.diff(aligned.time_functions, axis=1)
    extreme = np.concatenate((primitive.sample(500, 3), 6.0 * primitive.mixture.sample(200, 0)))
    drawn = np.diff(dataclasses.replace(primitive, duration_range_s=None).time_functions(extreme), axis=1)
    free = dataclasses.replace(primitive, log_slope_range=None, duration_range_s=None)
    rebuilt = np.diff(free.time_functions(latents_of_examples(primitive, aligned)), axis=1)
    least, most = min(given.min(), rebuilt.min()), max(given.max(), rebuilt.max())
    assert least * 0.95 <= drawn.min()
    assert drawn.max() <= most * 1.06
    assert np.diff(free.time_functions(extreme), axis=1).max() > most * 1.06


def test_examples_are_rebuilt_as_if_nothing_were_cut_off() -> None:
    for examples, options in ((bending_chains(30), QUICK), (walks(), QUICK)):
        primitive = train_primitive(examples, options).primitive
        latents = latents_of_examples(primitive, examples)
        free = dataclasses.replace(primitive, log_slope_range=None)
        np.testing.assert_array_equal(primitive.time_functions(latents), free.time_functions(latents))


def latents_of_examples(primitive: MotionPrimitive, aligned: AlignedSet) -> Floats:
    return primitive.latents_of(consistent_poses(aligned.poses, aligned.clips[0].motion.poses), aligned.time_functions)


def test_samples_last_no_longer_or_shorter_than_the_examples_by_more_than_a_fifth() -> None:
    aligned = bending_chains(30)
    primitive = train_primitive(aligned, QUICK).primitive
    durations = aligned.time_functions[:, -1] / aligned.frame_rate_hz
    free = dataclasses.replace(primitive, duration_range_s=None, log_slope_range=None)
    drawn = primitive.durations_s(primitive.sample(2000, 3))
    assert durations.min() * 0.8 <= drawn.min()
    assert drawn.max() <= durations.max() * 1.2
    assert free.durations_s(free.sample(2000, 3)).max() > durations.max() * 1.2
    np.testing.assert_array_equal(primitive.sample(20, 3), primitive.sample(2000, 3)[:20])


def test_motions_last_as_long_as_their_latent_vectors_say() -> None:
    primitive = train_primitive(walks(), QUICK).primitive
    latents = primitive.sample(6, 0)
    for motion, seconds in zip(primitive.motions(latents), primitive.durations_s(latents), strict=True):
        assert (motion.frame_count - 1) / primitive.frame_rate_hz == pytest.approx(seconds, abs=0.5 / 60.0)


def test_a_mixture_of_a_known_latent_space_is_recovered() -> None:
    """The examples are of two kinds of motion in a space of three functions."""
    random = np.random.default_rng(0)
    skeleton, basis, examples = chain(), SplineBasis.clamped(40, 8), 120
    modes = np.zeros((3, 8, 19))
    modes[0, :, 0], modes[1, :, 1], modes[2, :, 2] = random.standard_normal((3, 8))
    kind = random.random(examples) < 0.5
    hidden = random.standard_normal((examples, 3)) * (0.3, 0.2, 0.1) + np.where(kind, 1.0, -1.0)[:, None]
    rest = np.concatenate((np.zeros(3), np.tile([1.0, 0.0, 0.0, 0.0], 4)))
    poses = basis.at_frames @ (rest + np.tensordot(hidden, modes, axes=1))
    trained = train_primitive(aligned_set(skeleton, poses), ModelOptions(spatial_share=0.9999))
    primitive = trained.primitive
    assert (primitive.spatial.count, primitive.temporal.count) == (3, 0)
    mixture = primitive.mixture
    assert len(mixture.weights) == 2
    drawn = primitive.sample(50, 1)
    expected = np.log(sum(
        weight * multivariate_normal(mean, primitive.widening * covariance).pdf(drawn)
        for weight, mean, covariance in zip(mixture.weights, mixture.means, mixture.covariances, strict=True)
    ))  # fmt: skip
    np.testing.assert_allclose(primitive.log_density(drawn), expected, rtol=1e-9)


def test_signs_of_quaternions_do_not_matter() -> None:
    aligned = walks()
    flips = np.where(np.random.default_rng(0).random((16, 1, aligned.skeleton.joint_count)) < 0.5, -1.0, 1.0)
    poses = aligned.poses
    poses[..., 3:] *= np.repeat(flips, 4, axis=2)
    poses[0] = aligned.poses[0]
    turned = aligned_set(aligned.skeleton, poses, aligned.time_functions)
    one, other = train_primitive(aligned, QUICK).primitive, train_primitive(turned, QUICK).primitive
    np.testing.assert_allclose(one.spatial.mean, other.spatial.mean, atol=1e-12)
    np.testing.assert_allclose(one.spatial.variances, other.spatial.variances, rtol=1e-9)


@pytest.mark.every_nth(3)
@pytest.mark.parametrize("scaling", SCALINGS)
def test_training_gives_the_same_bytes_every_time_and_on_any_number_of_threads(scaling: Scaling) -> None:
    aligned = walks(12, 30)
    options = ModelOptions(scaling=scaling) if is_soak() else ModelOptions(scaling=scaling, starts=2, report_samples=20)
    first = as_bytes(train_primitive(aligned, options, seed=3))
    if scaling == SCALINGS[0] or is_soak():
        assert as_bytes(train_primitive(aligned, options, seed=3)) == first
    assert as_bytes(train_primitive(aligned, options, seed=3, threads=2)) == first


# -- the report --------------------------------------------------------------------------------------------------------


def test_what_a_left_out_example_loses_is_what_a_model_without_it_loses() -> None:
    aligned = bending_chains(8)
    options = QUICK.replace(spatial_share=1.0)
    fitted = fit_examples(aligned, options)
    found = reconstruction_errors(aligned.skeleton, fitted.spatial, fitted.poses, 5)
    basis = fitted.spatial.functions.basis
    frames = comparison_frames(basis)
    coefficients = basis.fit(fitted.poses)
    for left_out in range(8):
        others = np.delete(coefficients, left_out, axis=0)
        for count in range(6):
            functions = find_components(basis, others, fitted.weights, Keep(count=count)).functions
            made = functions.coefficients(functions.scores(coefficients[left_out][None]))[0]
            reached = forward_kinematics(aligned.skeleton, unit_poses(basis.at_frames @ made)[frames])
            wanted = forward_kinematics(aligned.skeleton, fitted.poses[left_out, frames])
            error = 100.0 * np.linalg.norm(reached - wanted, axis=2).mean()
            assert present(found.left_out_each_cm)[left_out, count] == pytest.approx(error, abs=1e-6)
    assert found.left_out_cm == pytest.approx(present(found.left_out_each_cm).mean(axis=0))


def test_all_examples_of_a_take_and_of_a_performer_are_left_out_together() -> None:
    """Steps of one take are nearly the same, so a model that has seen one of them has seen the others."""
    aligned = bending_chains(12)
    takes, subjects = np.repeat(np.arange(6), 2), np.repeat(np.arange(3), 4)
    fitted = fit_examples(aligned, QUICK.replace(spatial_share=1.0))
    found = reconstruction_errors(
        aligned.skeleton, fitted.spatial, fitted.poses, 3, groups=ExampleGroups(takes, subjects)
    )
    basis = fitted.spatial.functions.basis
    frames = comparison_frames(basis)
    coefficients = basis.fit(fitted.poses)

    def error_without(left_out: Flags, example: int) -> float:
        functions = find_components(basis, coefficients[~left_out], fitted.weights, Keep(count=2)).functions
        made = functions.coefficients(functions.scores(coefficients[example][None]))[0]
        reached = forward_kinematics(aligned.skeleton, unit_poses(basis.at_frames @ made)[frames])
        wanted = forward_kinematics(aligned.skeleton, fitted.poses[example, frames])
        return float(100.0 * np.linalg.norm(reached - wanted, axis=2).mean())

    by_subject = [error_without(subjects == subjects[example], example) for example in range(12)]
    for example in range(12):
        expected = error_without(takes == takes[example], example)
        assert present(found.left_out_each_cm)[example, 2] == pytest.approx(expected, abs=1e-6)
    assert found.left_out_subject_cm is not None
    assert found.left_out_subject_cm[2] == pytest.approx(np.mean(by_subject), abs=1e-6)


def test_a_report_counts_takes_and_performers_and_mirrored_copies_are_of_the_same_take() -> None:
    aligned = bending_chains(12)
    clips = tuple(
        replace(
            clip, uid=f"{clip.uid}{MIRRORED if number % 2 else ''}", recording=Recording(f"take {number // 2}", who)
        )
        for number, (clip, who) in enumerate(zip(aligned.clips, "aaaabbbbcccc", strict=True))
    )
    trained = train_primitive(replace(aligned, clips=clips))
    report = trained.report
    assert (report.takes, report.subjects) == (6, 3)
    assert verdict_of(trained).startswith("12 examples of 6 takes in ")
    assert "of a left-out performer" in verdict_of(trained)
    assert report.held_out_subject_log_likelihood is not None
    assert headline_of(trained)["left_out_subject_error_cm"] is not None
    copies = tuple(replace(clip, uid=clip.uid + end) for clip in aligned.clips[:6] for end in ("", MIRRORED))
    assert ExampleGroups.of(replace(aligned, clips=copies)).take_count == 6


def test_with_one_take_no_error_of_unseen_takes_is_stated() -> None:
    aligned = walks(8)
    clips = tuple(replace(clip, recording=Recording("take 1")) for clip in aligned.clips)
    trained = train_primitive(replace(aligned, clips=clips), ModelOptions(spatial_share=1.0, starts=1))
    errors = trained.report.reconstruction
    assert errors is not None
    assert errors.left_out_cm is None
    assert errors.left_out_each_cm is None
    assert all(example.left_out_error_cm is None for example in trained.report.examples)
    assert "does-not-generalise" not in [warning.code for warning in trained.warnings]
    assert "the mean error of a left-out take is unknown: all examples come from one take" in verdict_of(trained)
    assert headline_of(trained)["left_out_error_cm"] is None
    written = trained_to_tree(trained, {"item": "skel_1", "revision": 1}, {})
    assert sorted(written["training"]["reconstruction"]) == ["components", "training_cm"]
    encode_tree(written, MSGPACK)


def test_the_diversity_of_one_sample_is_not_known() -> None:
    comparison = train_primitive(bending_chains(6), QUICK.replace(report_samples=1)).report.comparison
    assert comparison is not None
    assert comparison.diversity_cm is None
    assert comparison.example_diversity_cm is not None


def test_more_components_lose_less_and_unseen_examples_lose_more() -> None:
    report = train_primitive(walks(24), ModelOptions(scaling="sfpca")).report
    errors = report.reconstruction
    assert (np.diff(present(errors).training_cm) < 0.05).all()
    assert (present(present(errors).left_out_cm) >= present(errors).training_cm - 1e-9).all()
    assert present(errors).training_cm[-1] < 0.2 * present(errors).training_cm[0]
    assert report.spatial_energy[-1] == pytest.approx(1.0)


def test_the_gradient_of_distances_of_joints_is_right() -> None:
    random = np.random.default_rng(3)
    skeleton = walks(1).skeleton
    poses = walks(1).poses[0, :3] + 0.2 * random.standard_normal((3, 3 + 4 * skeleton.joint_count))
    targets = forward_kinematics(skeleton, unit_poses(poses)) + 0.1 * random.standard_normal(
        (3, skeleton.joint_count, 3)
    )

    def error(at: Floats) -> tuple[float, Floats]:
        gradient = np.empty_like(at)
        arguments = (at, skeleton.parents, skeleton.offsets, targets, gradient)
        return reconstruction_kernels.squared_error_gradient(*arguments), gradient

    total, gradient = error(poses)
    assert total == pytest.approx(((forward_kinematics(skeleton, unit_poses(poses)) - targets) ** 2).sum())
    for column in range(0, poses.shape[1], 5):
        change = np.zeros_like(poses)
        change[1, column] = 1e-6
        slope = (error(poses + change)[0] - error(poses - change)[0]) / 2e-6
        assert gradient[1, column] == pytest.approx(slope, rel=1e-5, abs=1e-6)


def test_an_example_unlike_the_others_is_named() -> None:
    aligned = bending_chains(30)
    poses = aligned.poses
    poses[7, :, 0] += np.linspace(0.0, 3.0, 30)
    trained = train_primitive(aligned_set(aligned.skeleton, poses, aligned.time_functions))
    assert [one.name for one in trained.report.examples if one.outlier] == ["clip 7"]
    (told,) = [warning for warning in trained.warnings if warning.code == "outliers"]
    assert "clip 7" in told.message


def test_the_report_tells_of_feet_durations_and_likelihoods() -> None:
    aligned = walks(24)
    trained = train_primitive(aligned, seed=1)
    report = trained.report
    assert present(report.training_feet).below_floor_share == 0.0
    assert 0.0 < present(report.sample_feet).slide_m_s < 1.0
    assert present(report.training_feet).slide_m_s < present(report.sample_feet).slide_m_s
    durations = aligned.time_functions[:, -1] / aligned.frame_rate_hz
    assert report.training_durations.most_s == pytest.approx(durations.max())
    assert present(report.held_out_log_likelihood) < report.log_likelihood
    assert np.mean([one.log_likelihood for one in report.examples]) == pytest.approx(report.log_likelihood)
    assert report.candidates[0].components == 1
    assert report.time_error_frames < 1.0
    assert trained.primitive.keyframes == {"contact": 20}
    assert verdict_of(trained).startswith("24 examples in ")
    assert headline_of(trained)["examples"] == 24


def test_feet_below_the_floor_are_told() -> None:
    aligned = walks(16)
    poses = aligned.poses
    poses[..., 1] -= 0.1
    trained = train_primitive(aligned_set(aligned.skeleton, poses, aligned.time_functions))
    assert present(trained.report.sample_feet).below_floor_share > 0.9
    assert "feet-below-floor" in [warning.code for warning in trained.warnings]


def test_feet_that_slide_in_samples_and_stand_in_examples_are_told() -> None:
    trained = train_primitive(walks(16), QUICK)
    standing, sliding, creeping = (FootQuality(0.0, 0.0, 1.0, speed) for speed in (0.04, 0.13, 0.07))

    def codes(examples: FootQuality, samples: FootQuality) -> list[str]:
        report = dataclasses.replace(trained.report, training_feet=examples, sample_feet=samples)
        return [warning.code for warning in warnings_of(trained.primitive, report, QUICK)]

    assert "feet-slide" in codes(standing, sliding)
    assert "feet-slide" not in codes(standing, creeping)
    assert "feet-slide" not in codes(sliding, sliding)


def test_time_components_that_hold_less_than_was_asked_for_are_told() -> None:
    options = QUICK.replace(most_temporal_components=1)
    trained = train_primitive(walks(16), options)
    kept = trained.primitive.temporal.count

    def codes(held: float) -> list[str]:
        energy = np.array([held, 1.0])
        report = dataclasses.replace(trained.report, temporal_energy=energy)
        return [warning.code for warning in warnings_of(trained.primitive, report, options)]

    assert kept == 1
    assert "time-components-missing" in codes(0.89)
    assert "time-components-missing" not in codes(0.995)


def test_few_examples_are_a_warning() -> None:
    codes = [warning.code for warning in train_primitive(walks(5)).warnings]
    assert "too-few-examples" in codes


def test_a_skeleton_without_feet_has_no_feet_to_report() -> None:
    report = train_primitive(bending_chains()).report
    assert report.training_feet is None
    assert report.sample_feet is None


def test_examples_of_a_set_without_its_reference_can_be_trained_on() -> None:
    aligned = dataclasses.replace(bending_chains(), reference="gone@1")
    assert train_primitive(aligned, QUICK).primitive.dimensions > 0


# -- what is refused ---------------------------------------------------------------------------------------------------


def changed(aligned: AlignedSet, index: int, **members: Any) -> AlignedSet:
    clips = list(aligned.clips)
    clips[index] = dataclasses.replace(clips[index], **members)
    return dataclasses.replace(aligned, clips=tuple(clips))


def test_examples_that_make_no_model_are_refused_by_name() -> None:
    aligned = bending_chains(4)
    odd: AlignedClip = aligned.clips[2]
    holes = odd.motion._replace(root_translations=np.full((30, 3), np.nan))
    loose = odd.motion._replace(translations=np.zeros((30, 1, 3)), translated_joints=(1,))
    back = odd.time_function.copy()
    back[5] = back[6]
    for members, told in (
        ({"time_function": odd.time_function[:20]}, "a time function of 20 frames, but the set has 30 frames"),
        ({"motion": holes}, "not finite"),
        ({"motion": loose}, "bone_1 moves relative to its parent"),
        ({"motion": odd.motion.at_frames(np.arange(20))}, "20 frames"),
        ({"time_function": back}, "is not strictly increasing"),
    ):
        with pytest.raises(MotionError, match=f"clip 2: .*{told}"):
            train_primitive(changed(aligned, 2, **members))
    with pytest.raises(MotionError, match="at least 5"):
        train_primitive(aligned_set(chain(), aligned.poses[:, :4]))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("scaling", "unit"),
        ("spatial_share", 1.5),
        ("temporal_coefficients", 3),
        ("folds", -1),
        ("temporal_weight", np.inf),
    ],
)
def test_options_out_of_range_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValidationError, match=name):
        ModelOptions(**{name: value})

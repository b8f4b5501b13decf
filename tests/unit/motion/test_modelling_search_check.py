"""Checks of searches, whose targets are places reached by examples that were not used to train the model."""

from dataclasses import replace

import numpy as np
import pytest
from tests.support.model_examples import walks
from tests.support.present import present

from marey_motion.alignment.aligned import AlignedSet, Recording
from marey_motion.kinematics import forward_kinematics
from marey_motion.modelling.search.check import SearchCheck, check_search
from marey_motion.rigs import map_joints
from marey_schemas.options.modelling import ModelOptions

OPTIONS = ModelOptions(starts=1)


def standard_joints(aligned: AlignedSet) -> dict[str, int]:
    return {name: aligned.skeleton.index_of(joint) for name, joint in map_joints(aligned.skeleton).joints.items()}


@pytest.fixture(scope="module")
def aligned() -> AlignedSet:
    return walks(16)


@pytest.fixture(scope="module")
def check(aligned: AlignedSet) -> SearchCheck:
    return present(check_search(aligned, standard_joints(aligned), OPTIONS, seed=1))


def test_every_fifth_example_but_never_the_reference_is_looked_for(aligned: AlignedSet, check: SearchCheck) -> None:
    assert sorted(set(check.examples)) == ["walk001", "walk006", "walk011"]
    assert set(check.joints) == {"left_wrist", "right_wrist", "left_ankle", "right_ankle"}
    assert len(check.searched_cm) == len(check.refined_cm) == len(check.frames) == 12


def test_refining_comes_nearer_than_the_samples_of_the_tree(check: SearchCheck) -> None:
    assert np.median(check.refined_cm) < np.median(check.searched_cm)
    assert np.median(check.refined_cm) < 1.0
    assert (check.searched_cm >= 0.0).all()


def test_the_same_seed_finds_the_same(aligned: AlignedSet, check: SearchCheck) -> None:
    again = check_search(aligned, standard_joints(aligned), OPTIONS, seed=1)
    assert np.array_equal(present(again).searched_cm, check.searched_cm)
    assert np.array_equal(present(again).refined_cm, check.refined_cm)


def test_places_where_the_other_examples_never_go_are_missed(aligned: AlignedSet) -> None:
    """The example that is left out is far away from all others, so no motion of the model comes near this example."""
    odd = aligned.clips[1]
    away = odd.motion._replace(root_translations=np.add(odd.motion.root_translations, (5.0, 0.0, 0.0)))
    clips = (aligned.clips[0], replace(odd, motion=away), *aligned.clips[2:])
    missed = check_search(replace(aligned, clips=clips), standard_joints(aligned), OPTIONS, seed=1)
    of_odd = [
        error for uid, error in zip(present(missed).examples, present(missed).refined_cm, strict=True) if uid == odd.uid
    ]
    assert min(of_odd) > 5.0


def test_targets_are_looked_for_where_examples_differ_most(aligned: AlignedSet, check: SearchCheck) -> None:
    poses = aligned.poses
    points = np.stack([forward_kinematics(aligned.skeleton, each) for each in poses])
    wrist = points[:, :, standard_joints(aligned)["left_wrist"]]
    widest = int(wrist.var(axis=0).sum(axis=-1).argmax())
    assert check.frames[check.joints.index("left_wrist")] == widest


def test_few_examples_and_unknown_joints_are_not_checked(aligned: AlignedSet) -> None:
    assert check_search(walks(9), standard_joints(aligned), OPTIONS, seed=0) is None
    assert check_search(aligned, {}, OPTIONS, seed=0) is None


def test_takes_that_leave_too_few_examples_are_not_checked() -> None:
    aligned = walks(12)
    takes = ["c", *"aaaaaaaabbb"]  # the first walk is the reference
    clips = tuple(replace(clip, recording=Recording(take)) for clip, take in zip(aligned.clips, takes, strict=True))
    assert check_search(replace(aligned, clips=clips), standard_joints(aligned), OPTIONS, seed=0) is None

"""Models as documents: every number is restored exactly from every encoding."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.modelling_examples import bending_chains, chain, walks
from tests.support.present import present

from marey_motion.errors import MotionError
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.primitive_documents import (
    primitive_from_tree,
    primitive_to_tree,
    trained_to_tree,
)
from marey_motion.modelling.training import TrainedPrimitive, train_primitive
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.models import MotionPrimitiveDocument
from marey_schemas.encoding.canonical import document_digest
from marey_schemas.encoding.codecs import MEDIA_TYPES, decode_tree, encode_tree

SKELETON = {"item": "skel_1", "revision": 2}


@pytest.fixture(scope="module")
def trained() -> TrainedPrimitive:
    return train_primitive(walks(12, 30), name="walk", seed=4)


@pytest.fixture(scope="module")
def swaying() -> MotionPrimitive:
    return train_primitive(bending_chains()).primitive


@pytest.mark.parametrize("media_type", MEDIA_TYPES)
def test_a_model_comes_back_bit_by_bit(trained: TrainedPrimitive, media_type: str) -> None:
    tree = trained_to_tree(trained, SKELETON, {"seed": 4})
    read = decode_tree(encode_tree(tree, media_type), media_type)
    assert document_digest(read) == document_digest(tree)
    MotionPrimitiveDocument.model_validate(read)
    primitive = primitive_from_tree(read, trained.primitive.skeleton)
    assert document_digest(primitive_to_tree(primitive, SKELETON)) == document_digest(
        primitive_to_tree(trained.primitive, SKELETON)
    )
    assert primitive.log_slope_range == trained.primitive.log_slope_range
    drawn = primitive.sample(3, 9)
    assert np.array_equal(drawn, trained.primitive.sample(3, 9))
    assert np.array_equal(primitive.poses(drawn), trained.primitive.poses(drawn))


def test_the_report_of_a_training_is_part_of_the_document(trained: TrainedPrimitive) -> None:
    written = trained_to_tree(trained, SKELETON, {})["training"]
    assert written["log_likelihood"] == trained.report.log_likelihood
    assert len(written["examples"]) == len(trained.report.examples)
    assert len(written["candidates"]) == len(trained.report.candidates)
    each = written["reconstruction"]["left_out_each_cm"]
    assert np.array_equal(each, present(present(trained.report.reconstruction).left_out_each_cm))
    assert "training" not in primitive_to_tree(trained.primitive, SKELETON)


def test_a_model_without_components_travels_too() -> None:
    single = train_primitive(bending_chains(1))
    tree = trained_to_tree(single, SKELETON, {})
    for media_type in MEDIA_TYPES:
        read = decode_tree(encode_tree(tree, media_type), media_type)
        MotionPrimitiveDocument.model_validate(read)
        primitive = primitive_from_tree(read, chain())
        assert np.array_equal(primitive.poses(np.empty((1, 0))), single.primitive.poses(np.empty((1, 0))))


def test_a_model_from_before_steps_were_cut_off_is_read_and_cuts_off_none_of_a_motion(
    trained: TrainedPrimitive,
) -> None:
    tree = primitive_to_tree(trained.primitive, SKELETON)
    del tree["log_slope_range"]
    MotionPrimitiveDocument.model_validate(tree)
    primitive = primitive_from_tree(tree, trained.primitive.skeleton)
    assert primitive.log_slope_range is None
    extreme = 1e6 * trained.primitive.mixture.sample(20, 0)
    assert (np.diff(primitive.time_functions(extreme), axis=1) > 0.0).all()


def test_a_range_of_steps_that_is_none_is_refused(trained: TrainedPrimitive) -> None:
    tree = primitive_to_tree(trained.primitive, SKELETON) | {"log_slope_range": [1.0, -1.0]}
    with pytest.raises(ValidationError, match="the second number must not be less"):
        MotionPrimitiveDocument.model_validate(tree)
    with pytest.raises(MotionError, match="must be in ascending order"):
        primitive_from_tree(tree, trained.primitive.skeleton)


def test_joints_may_stand_in_another_order(swaying: MotionPrimitive) -> None:
    tree = primitive_to_tree(swaying, SKELETON)
    branched = Skeleton(
        ("bone_0", "bone_2", "bone_1", "bone_3"), np.array([-1, 0, 0, 0]), chain().offsets, chain().rest_rotations
    )
    read = primitive_from_tree(tree, branched)
    latents = swaying.sample(2, 0)
    here, there = (one.poses(latents)[..., 3:].reshape(2, -1, 4, 4) for one in (read, swaying))
    np.testing.assert_array_equal(here, there[:, :, [0, 2, 1, 3]])


def test_splines_without_a_degree_are_cubic(swaying: MotionPrimitive) -> None:
    tree = primitive_to_tree(swaying, SKELETON)
    without_degree = {
        name: {key: one for key, one in tree[name].items() if key != "degree"} for name in ("spatial", "temporal")
    }
    read = primitive_from_tree({**tree, **without_degree}, swaying.skeleton)
    assert (read.spatial.basis.degree, read.temporal.basis.degree) == (3, 3)


def test_a_model_of_other_joints_is_refused(swaying: MotionPrimitive) -> None:
    tree = primitive_to_tree(swaying, SKELETON)
    with pytest.raises(MotionError, match="the model and the skeleton differ: bone_4"):
        primitive_from_tree(tree, chain(5))
    with pytest.raises(MotionError, match="marey/motion@1"):
        primitive_from_tree({**tree, "schema": "marey/motion@1"}, chain())


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (("joints",), "19 channels, but the joints need 15"),
        (("spatial", "knots"), "knots"),
        (("spatial", "projections"), "projections"),
        (("temporal", "variances"), "variances"),
        (("mixture", "means"), "components; the two numbers must be equal"),
        (("mixture", "weights"), "weights"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(place: tuple[Any, ...], message: str, swaying: MotionPrimitive) -> None:
    tree = primitive_to_tree(swaying, SKELETON)
    holder = tree
    for name in place[:-1]:
        holder = holder[name]
    value = holder[place[-1]]
    holder[place[-1]] = value[..., :-1] if isinstance(value, np.ndarray) else value[:-1]
    if place == ("mixture", "means"):
        tree["mixture"]["covariances"] = tree["mixture"]["covariances"][:, :-1, :-1]
    with pytest.raises(ValidationError, match=message):
        MotionPrimitiveDocument.model_validate(tree)

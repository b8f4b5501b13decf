"""Durations of the motions of a model, for any latent vector."""

from dataclasses import replace

import numpy as np
import pytest
from tests.support.present import present
from tests.support.search_primitives import standard_joints, walking

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.search.constraints import InvalidConstraint
from marey_motion.modelling.search.objective import build_objective
from marey_schemas.search_constraints import KeyframeTimeConstraint

FAR = 1e3


def bounded() -> tuple[MotionPrimitive, Floats]:
    primitive, joints = walking()
    usual = float(primitive.durations_s(np.zeros((1, primitive.dimensions)))[0])
    return replace(primitive, duration_range_s=(0.8 * usual, 1.2 * usual)), joints


def test_a_motion_lasts_no_longer_than_the_model_allows_and_within_that_as_its_latents_say() -> None:
    primitive, _ = bounded()
    free = replace(primitive, duration_range_s=None)
    odd = np.zeros((2, primitive.dimensions))
    odd[0, primitive.spatial.count], odd[1, primitive.spatial.count] = FAR, -FAR
    assert sorted(primitive.durations_s(odd)) == pytest.approx(primitive.duration_range_s)
    usual = np.zeros((1, primitive.dimensions))
    assert np.array_equal(primitive.time_functions(usual), free.time_functions(usual))


def test_a_motion_of_millions_of_frames_is_refused() -> None:
    free, _ = walking()
    latent = np.zeros((1, free.dimensions))
    latent[0, free.spatial.count] = FAR if free.durations_s(_moved(free, FAR)) > free.durations_s(latent) else -FAR
    with pytest.raises(MotionError, match="far longer than the motions"):
        free.motions(latent)


def _moved(primitive: MotionPrimitive, amount: float) -> Floats:
    latent = np.zeros((1, primitive.dimensions))
    latent[0, primitive.spatial.count] = amount
    return latent


def test_a_time_that_no_motion_of_the_model_reaches_is_refused() -> None:
    primitive, _ = bounded()
    with pytest.raises(InvalidConstraint, match="last"):
        build_objective(
            primitive,
            [KeyframeTimeConstraint(at="end", seconds=3.0 * present(primitive.duration_range_s)[1])],
            standard_joints(),
        )

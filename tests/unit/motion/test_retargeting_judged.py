"""Retargeting between pairs of real rigs, judged as an animator does."""

from pathlib import Path

import pytest
from tests.support.judged_rigs import PAIRS, RIGS, Actor, JudgedRetargeting, plan_between
from tests.support.tiers import is_soak

from marey_motion.retargeting import retarget

SHORT = 2
JUDGED = [pytest.param(*pair, marks=[pytest.mark.soak] if number >= SHORT else []) for number, pair in enumerate(PAIRS)]


@pytest.fixture(scope="module")
def rigs(mocap: Path) -> dict[str, Actor]:
    """All rigs in the tier soak, otherwise those of the first pairs."""
    used = {name for pair in PAIRS[: None if is_soak() else SHORT] for name in pair}
    return {name: Actor.of(mocap, RIGS[name]) for name in used}


@pytest.mark.parametrize(("source", "target"), JUDGED)
def test_the_soles_stand_on_the_floor_of_the_source(rigs: dict[str, Actor], source: str, target: str) -> None:
    plan = plan_between(rigs[source], rigs[target])
    judged = JudgedRetargeting(rigs[source], rigs[target], retarget(rigs[source].clip, plan), plan.scale)

    assert abs(judged.soles_off_m) < 0.015


@pytest.mark.parametrize(("source", "target"), JUDGED)
def test_neck_and_hip_line_point_as_in_the_source(rigs: dict[str, Actor], source: str, target: str) -> None:
    plan = plan_between(rigs[source], rigs[target])
    judged = JudgedRetargeting(rigs[source], rigs[target], retarget(rigs[source].clip, plan), plan.scale)

    assert judged.off_deg("neck", "head") < 1.0
    assert judged.off_deg("right_hip", "left_hip") < 2.0

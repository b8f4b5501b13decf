"""Retargeting between pairs of real rigs, judged as an animator does."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.judged_rigs import PAIRS, RIGS, Actor, JudgedRetargeting, degrees_between, plan_between
from tests.support.tiers import is_soak

from marey_motion import kinematics
from marey_motion.retargeting import retarget, retarget_with_checks
from marey_schemas.options.retargeting import RetargetOptions

SHORT = 2
CARTWHEEL = "cmu-amc/49/49_06.amc"
JUDGED = [pytest.param(*pair, marks=[pytest.mark.soak] if number >= SHORT else []) for number, pair in enumerate(PAIRS)]


@pytest.fixture(scope="module")
def rigs(mocap: Path) -> dict[str, Actor]:
    """All rigs in the tier soak, otherwise the rigs of the first pairs."""
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


@pytest.mark.parametrize(("source", "target"), JUDGED)
def test_kept_feet_slide_no_more_than_those_of_the_source(rigs: dict[str, Actor], source: str, target: str) -> None:
    plan = plan_between(rigs[source], rigs[target])
    made = retarget_with_checks(rigs[source].clip, plan, RetargetOptions(keep_feet=True))
    judged = JudgedRetargeting(rigs[source], rigs[target], made.clip, plan.scale)

    slides, knees = judged.contact_speeds_m_s, judged.knee_speeds_deg_s
    assert slides[1] < 1.2 * slides[0]
    assert abs(judged.soles_off_m) < 0.015
    assert knees[1] < 1.1 * knees[0] + 100.0, "knees do not pop"
    (check,) = (check for check in made.checks if check.code == "feet-kept")
    assert check.values["slide_after_m"] < 1e-6
    assert 0.0 < check.values["moved_m"] < 0.15 or check.values["contacts"] == 0


@pytest.mark.parametrize(("source", "target"), JUDGED)
def test_kept_hands_are_where_those_of_the_source_are(rigs: dict[str, Actor], source: str, target: str) -> None:
    plan = plan_between(rigs[source], rigs[target])
    made = retarget_with_checks(rigs[source].clip, plan, RetargetOptions(keep_feet=True, keep_hands=True))
    judged = JudgedRetargeting(rigs[source], rigs[target], made.clip, plan.scale)

    (check,) = (check for check in made.checks if check.code == "hands-kept")
    off, lifted = judged.hands_off_m(check.values["scale"]), check.values["lifted_m"]
    assert off < 0.02 + lifted, "only hands that are lifted to the floor are elsewhere"
    assert lifted == 0.0 or (source, target) == ("boxing", "geno"), "no other actor touches the floor"
    assert lifted > 0.0 or off == pytest.approx(check.values["missed_m"], abs=1e-5)
    arms = judged.upper_arm_speeds_deg_s
    assert arms[1] < (1.6 if lifted else 1.25) * arms[0], "elbows do not snap"
    assert judged.contact_speeds_m_s[1] < 1.2 * judged.contact_speeds_m_s[0]


def test_hands_that_meet_in_the_source_meet_in_the_result(rigs: dict[str, Actor]) -> None:
    source, target = (rigs[name] for name in PAIRS[0])
    plan = plan_between(source, target)
    checks = [retarget_with_checks(source.clip, plan, RetargetOptions(keep_hands=kept)) for kept in (True, False)]
    scale = next(check.values["scale"] for check in checks[0].checks if check.code == "hands-kept")

    errors = []
    for made in checks:
        ways = JudgedRetargeting(source, target, made.clip, plan.scale).way("left_wrist", "right_wrist")
        errors.append(np.linalg.norm(ways[1] - scale * ways[0], axis=1).max())
    assert errors[0] < 0.005
    assert errors[1] > 0.03, "without the option they do not"


def test_hands_are_kept_in_the_world_as_far_as_arms_reach(rigs: dict[str, Actor]) -> None:
    source, target = (rigs[name] for name in PAIRS[1])
    plan = plan_between(source, target)
    made = retarget_with_checks(source.clip, plan, RetargetOptions(keep_hands=True, hands_from="world"))
    judged = JudgedRetargeting(source, target, made.clip, plan.scale)

    off = np.stack([after - plan.scale * before for before, after in map(judged.places, ("left_wrist", "right_wrist"))])
    missed = np.linalg.norm(off, axis=-1).max()
    (check,) = (check for check in made.checks if check.code == "hands-kept")
    assert missed == pytest.approx(check.values["missed_m"], abs=1e-5)
    for side in ("left", "right"):
        upper, fore = (
            judged.way(f"{side}_{a}", f"{side}_{b}")[1] for a, b in (("shoulder", "elbow"), ("elbow", "wrist"))
        )
        far = np.linalg.norm(off[int(side == "right")], axis=1) > 0.02
        assert degrees_between(upper[far], fore[far]).max(initial=0.0) < 15.0, "an arm that misses is stretched"


def test_hands_and_feet_of_a_cartwheel_are_kept_on_the_floor(mocap: Path) -> None:
    """The arms of the target are long for its legs, so its hands go through the floor."""
    source, target = Actor.of(mocap, CARTWHEEL), Actor.of(mocap, RIGS["game"])
    plan = plan_between(source, target)

    def made(**options: Any) -> tuple[float, dict[str, Any]]:
        result = retarget_with_checks(source.clip, plan, RetargetOptions(**options))
        lowest = kinematics.global_positions(result.clip, end_sites=True)[..., 1].min()
        return float(lowest), {check.code: check.values for check in result.checks}

    lowest, checks = made()
    assert lowest < -0.35
    assert checks["below-floor"]["hand_m"] == pytest.approx(0.41, abs=0.02)
    lowest, checks = made(keep_hands=True, keep_feet=True)
    assert lowest > -0.04, "the hands of the source are as low"
    assert "below-floor" not in checks
    assert checks["hands-kept"]["lifted_m"] > 0.35


def test_where_hands_are_scaled_from_needs_hands_that_are_kept() -> None:
    with pytest.raises(ValidationError, match="add keep_hands, or leave out hands_from"):
        RetargetOptions(hands_from="world")

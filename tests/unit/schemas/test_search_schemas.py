"""Requests for searches: one unit per quantity, and the field names of release 0.1."""

import json

import pytest
from pydantic import ValidationError

from marey_schemas.search import SearchRequest
from marey_schemas.search_constraints import RootPositionConstraint
from marey_schemas.validation.reasons import first_reason

AHEAD = {"type": "root_position", "at": "end", "target_m": [0.0, 1.0]}


def test_tolerances_of_places_are_metres_like_the_places() -> None:
    request = SearchRequest.model_validate({"constraints": [{**AHEAD, "tolerance_m": 0.03}]})
    assert request.constraints[0].model_dump()["tolerance_m"] == 0.03
    assert request.transition_tolerance_m == 0.02


def test_centimetres_of_release_0_1_are_understood() -> None:
    old = {"constraints": [{**AHEAD, "tolerance_cm": 3}], "transition_tolerance_cm": 4}
    new = {"constraints": [{**AHEAD, "tolerance_m": 0.03}], "transition_tolerance_m": 0.04}
    read = SearchRequest.model_validate_json(json.dumps(old), strict=True)
    assert read == SearchRequest.model_validate(old) == SearchRequest.model_validate(new)
    assert "cm" not in read.model_dump_json(exclude_unset=True)


@pytest.mark.parametrize("tolerance", [{"tolerance_cm": 0}, {"tolerance_cm": "far"}, {"tolerance_m": 1e-6}])
def test_a_tolerance_out_of_range_is_refused_in_either_unit(tolerance: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        SearchRequest.model_validate({"constraints": [{**AHEAD, **tolerance}]})


def test_both_units_at_once_are_refused() -> None:
    with pytest.raises(ValidationError, match="give only tolerance_m"):
        SearchRequest.model_validate({"constraints": [{**AHEAD, "tolerance_cm": 3, "tolerance_m": 0.03}]})


HEAD = {"joint": "head", "at": "end"}
LOOK = {**HEAD, "type": "look_direction"}


@pytest.mark.parametrize(
    ("constraint", "reason"),
    [
        (
            {**AHEAD, "target_m": [None, None]},
            "constraints.0.target_m: give at least one coordinate of the target position",
        ),
        (
            {**HEAD, "type": "joint_position", "target_m": [None, None, None]},
            "constraints.0.target_m: give at least one coordinate of the target position",
        ),
        (
            {**HEAD, "type": "joint_orientation", "rotation": [0, 0, 0, 0]},
            "constraints.0.rotation: at least one component must not be zero",
        ),
        (
            {**LOOK, "direction": [0, 0, 1], "axis": [0, 0, 0]},
            "constraints.0.axis: at least one component must not be zero",
        ),
        (LOOK, "constraints.0: give exactly one of direction and point_m"),
        (
            {**LOOK, "direction": [0, 0, 1], "point_m": [0, 0, 1]},
            "constraints.0: give exactly one of direction and point_m",
        ),
    ],
)
def test_a_constraint_without_a_meaning_is_refused_at_its_place_with_the_reason(
    constraint: dict[str, object], reason: str
) -> None:
    request = {"constraints": [constraint]}
    with pytest.raises(ValidationError) as caught:
        SearchRequest.model_validate(request)
    assert first_reason(caught.value, SearchRequest, request) == reason


def test_a_constraint_in_a_request_has_a_type_which_python_adds() -> None:
    with pytest.raises(ValidationError, match="type"):
        SearchRequest.model_validate({"constraints": [{"at": "end", "target_m": [0.0, 1.0]}]})
    made = RootPositionConstraint(at="end", target_m=(0.0, 1.0))
    assert made.model_dump(mode="json", exclude_unset=True) == AHEAD

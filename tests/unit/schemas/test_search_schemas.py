"""Requests for searches: one unit per quantity, and the spellings of release 0.1."""

import json

import pytest
from pydantic import ValidationError

from marey_schemas.search import SearchRequest

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

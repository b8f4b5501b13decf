import json
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError
from tests.support.tiers import examples

from marey_schemas.encoding import blocks
from marey_schemas.encoding.arrays import Array, ArrayError, ArrayOf, EncodedArray, array_from_leaf, nested_lists


class Take(BaseModel):
    poses: Annotated[NDArray[np.float32], ArrayOf("<f4", ndim=2, columns=7)]
    labels: Array


POSES = np.arange(21, dtype=np.float32).reshape(3, 7)
LABELS = np.zeros(2, np.int32)


def leaf(data: object, dtype: str = "<f4", shape: list[int] | None = None, **more: Any) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [3] if shape is None else shape, "data": data, **more}


def refusal(value: dict[str, Any], **limits: int) -> ArrayError:
    with pytest.raises(ArrayError) as caught:
        array_from_leaf(value, **limits)
    return caught.value


def test_a_model_takes_an_ndarray_a_leaf_or_an_encoded_array() -> None:
    for given_as in (POSES, leaf(POSES.tolist(), shape=[3, 7]), leaf(POSES.tobytes(), shape=[3, 7])):
        assert np.array_equal(Take(poses=given_as, labels=LABELS).poses, POSES)
    assert np.array_equal(Take(poses=EncodedArray.of(POSES), labels=LABELS).poses, POSES)


def test_a_model_goes_through_json_text_and_back() -> None:
    take = Take(poses=POSES / 10, labels=LABELS)
    again = Take.model_validate_json(take.model_dump_json())
    assert again.poses.tobytes() == take.poses.tobytes()
    assert again.labels.dtype == np.int32


def test_a_model_dumped_to_python_keeps_its_arrays() -> None:
    assert isinstance(Take(poses=POSES, labels=LABELS).model_dump()["poses"], np.ndarray)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (POSES.astype(np.float64), "expected dtype <f4, not <f8"),
        (POSES[0], "expected 2 dimensions"),
        (POSES[:, :6], r"expected 7 columns, not shape \[3, 6\]"),
        (POSES * np.float32(np.nan), "nan; only finite numbers"),
        (POSES.tolist(), "expected an array"),
        ("poses", "expected an array"),
        (leaf([1, 2]), r"on axis 0, a list of 3 is needed, not a list of 2"),
        (EncodedArray("<f4", (3, 7), b"rubbish"), "not a block-encoded array"),
    ],
)
def test_a_model_refuses_another_array_and_says_why(value: object, words: str) -> None:
    with pytest.raises(ValidationError, match=words) as caught:
        Take(poses=value, labels=LABELS)
    assert caught.value.errors()[0]["loc"] == ("poses",)


def test_the_json_schema_of_a_field_states_dtype_and_dimensions() -> None:
    schema = Take.model_json_schema()["properties"]["poses"]
    assert schema["properties"]["dtype"] == {"const": "<f4"}
    assert schema["properties"]["shape"]["minItems"] == schema["properties"]["shape"]["maxItems"] == 2
    assert schema["required"] == ["dtype", "shape", "data"]


@pytest.mark.parametrize(
    ("value", "code"),
    [
        (leaf([1, 2]), "bad-array"),
        (leaf([1, 2, [3]]), "bad-array"),
        (leaf([[1, 2], [3]], shape=[2, 2]), "bad-array"),
        (leaf([1, 2, "3"]), "bad-array"),
        (leaf([1, 2, None]), "bad-array"),
        (leaf([1, 2, True]), "bad-array"),
        (leaf({"0": 1}), "bad-array"),
        (leaf("123"), "bad-array"),
        (leaf([1.0, 2.5, 3.0], "<i4"), "bad-array"),
        (leaf([1, 0, 1], "|b1"), "bad-array"),
        (leaf([1, 2, 256], "|u1"), "out-of-range"),
        (leaf([1, 2, -1], "<u8"), "out-of-range"),
        (leaf([1, 2, 10**400], "<f8"), "out-of-range"),
        (leaf([1, 2, 1e39]), "not-finite"),
        (leaf(bytes(11)), "bad-array"),
        (leaf(bytes([0, 1, 2]), "|b1"), "bad-array"),
        (leaf(np.array([1, np.inf, 2], np.float32).tobytes()), "not-finite"),
        (leaf(bytes(12), extra=1), "bad-array"),
        (leaf(bytes(12), encoding="gzip"), "bad-array"),
        (leaf([1, 2, 3], encoding="blocks"), "bad-array"),
        (leaf(b"rubbish", encoding="blocks"), "bad-array"),
        (leaf(blocks.encode(np.zeros(4, np.float32)), encoding="blocks"), "bad-array"),
        (leaf(blocks.encode(np.zeros(3)), encoding="blocks"), "bad-array"),
        (leaf(blocks.encode(np.array([1, np.nan, 2], np.float32)), encoding="blocks"), "not-finite"),
    ],
)
def test_a_leaf_whose_data_does_not_match_its_claim_is_refused(value: dict[str, Any], code: str) -> None:
    assert refusal(value).code == code


@pytest.mark.parametrize("data", [[], b"", blocks.encode(np.zeros((100_000, 30), np.float32))])
def test_a_claim_beyond_the_limit_is_refused_before_the_data_is_looked_at(data: object) -> None:
    value = leaf(data, shape=[100_000, 30], **({"encoding": "blocks"} if data else {}))
    assert refusal(value, max_bytes=1_000_000).code == "too-large"


@pytest.mark.parametrize(
    ("data", "dtype", "shape"),
    [(2.5, "<f4", []), ([], "<i2", [0]), ([[], []], "|b1", [2, 0]), ([2**64 - 1], "<u8", [1]), ([True], "|b1", [1])],
)
def test_scalars_empty_arrays_and_extremes_are_arrays(data: object, dtype: str, shape: list[int]) -> None:
    array = array_from_leaf(leaf(data, dtype, shape))
    assert array.dtype.str == dtype
    assert array.tolist() == data


@given(bits=st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=50))
@settings(max_examples=examples(500))
def test_float32_written_as_json_reads_back_to_the_bit(bits: list[int]) -> None:
    array = np.array(bits, np.uint32).view(np.float32)
    array = array[np.isfinite(array)]
    text = json.dumps(nested_lists(array))
    assert np.array(json.loads(text), np.float32).tobytes() == array.tobytes()


def test_a_float32_whose_shortest_text_would_be_misread_comes_back_to_the_bit() -> None:
    awkward = np.array([0x15AE43FD, 0x95AE43FD, 0x15AE43FE], np.uint32).view(np.float32)
    for array in (awkward, awkward[0]):
        text = json.dumps(nested_lists(array))
        assert np.array(json.loads(text), np.float32).tobytes() == array.tobytes()


def test_float32_is_written_with_few_digits() -> None:
    assert json.dumps(nested_lists(np.array([0.1, 1.5, -123.456, -0.0], np.float32))) == "[0.1, 1.5, -123.456, -0.0]"

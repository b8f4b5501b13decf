import hashlib
import json
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.canonical import (
    array_digest,
    attach_arrays,
    canonical_json,
    detach_arrays,
    document_digest,
)
from marey_schemas.encoding.codecs import MEDIA_TYPES, decode_tree, encode_tree

POSES = np.arange(6, dtype=np.float32).reshape(2, 3)
TREE = {"b": [1, 2.5, None, True, "é"], "a": {"poses": POSES}}


def test_an_array_is_named_by_its_dtype_shape_and_bytes() -> None:
    expected = hashlib.sha256(b"<f4 [2,3]\n" + POSES.tobytes()).hexdigest()
    assert array_digest(POSES) == f"sha256:{expected}"


@pytest.mark.parametrize("same", [POSES.astype(">f4"), np.asfortranarray(POSES), EncodedArray.of(POSES)])
def test_the_name_of_an_array_does_not_depend_on_how_it_is_stored(same: NDArray[Any] | EncodedArray) -> None:
    assert array_digest(same) == array_digest(POSES)


@pytest.mark.parametrize(
    "other", [POSES.reshape(3, 2), POSES.view(np.int32), POSES + 1, -POSES, POSES.reshape(1, 2, 3)]
)
def test_other_arrays_have_other_names(other: NDArray[Any] | EncodedArray) -> None:
    assert array_digest(other) != array_digest(POSES)


def test_scalars_and_empty_arrays_have_names() -> None:
    assert array_digest(np.array(1.0)) != array_digest(np.array([1.0]))
    assert array_digest(np.zeros((0, 3))) != array_digest(np.zeros((0, 2)))


def test_canonical_json_has_sorted_keys_no_spaces_and_utf_8() -> None:
    assert (
        canonical_json({"b": [1, None], "a": {"ä": "é", "B": True}}) == '{"a":{"B":true,"ä":"é"},"b":[1,null]}'.encode()
    )


@pytest.mark.parametrize(
    ("a", "b"), [(1, 1.0), (0, -0.0), (10**17, 1e17), (10**22, 1e22), (-(2**63), -(2.0**63)), (100, 1e2)]
)
def test_equal_numbers_are_written_alike(a: object, b: object) -> None:
    assert canonical_json(a) == canonical_json(b)


@pytest.mark.parametrize(("a", "b"), [(1, True), (0, False), (0, None), ("1", 1), (0.1, 0.1000001), (2**53, 2**53 + 1)])
def test_other_values_are_written_differently(a: object, b: object) -> None:
    assert canonical_json(a) != canonical_json(b)


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_have_no_canonical_form(number: float) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        canonical_json({"a": number})


def test_keys_that_are_no_strings_have_no_canonical_form() -> None:
    with pytest.raises(TypeError, match="key 1"):
        canonical_json({1: "a"})


def test_a_document_keeps_its_name_through_every_media_type_and_key_order() -> None:
    name = document_digest(TREE)
    assert document_digest({"a": TREE["a"], "b": TREE["b"]}) == name
    for media_type in MEDIA_TYPES:
        assert document_digest(decode_tree(encode_tree(TREE, media_type), media_type)) == name
    assert document_digest({"a": {"poses": EncodedArray.of(POSES)}, "b": TREE["b"]}) == name


def test_a_document_is_named_by_its_canonical_json_with_references_for_arrays() -> None:
    text = json.dumps({"p": {"content": array_digest(POSES), "dtype": "<f4", "shape": [2, 3]}}, separators=(",", ":"))
    assert document_digest({"p": POSES}) == f"sha256:{hashlib.sha256(text.encode()).hexdigest()}"


def test_changing_one_number_changes_the_name() -> None:
    assert document_digest({"p": POSES}) != document_digest({"p": POSES + np.float32(1e-3)})


def test_arrays_are_detached_and_attached_again() -> None:
    kept: dict[str, Any] = {}
    detached = detach_arrays(TREE, kept.__setitem__)
    assert list(kept) == [array_digest(POSES)]
    assert json.loads(json.dumps(detached))["a"]["poses"]["content"] == array_digest(POSES)
    attached = attach_arrays(detached, kept.__getitem__)
    assert attached["a"]["poses"] is POSES
    assert attached["b"] == TREE["b"]

import numpy as np
import pytest

from marey_schemas.encoding.arrayspec import (
    DTYPES,
    MAX_DIMENSIONS,
    ArrayError,
    ArraySpec,
    little_endian,
    require_finite,
)


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_spec_of_an_array_counts_its_bytes(dtype: str) -> None:
    array = np.zeros((3, 5, 2), dtype)
    assert ArraySpec.of(array) == ArraySpec(dtype, (3, 5, 2))
    assert ArraySpec.of(array).nbytes == array.nbytes


@pytest.mark.parametrize("dtype", ["<f2", ">f4", "f4", "<c8", "", None, 4])
def test_other_dtypes_are_refused(dtype: object) -> None:
    with pytest.raises(ArrayError) as caught:
        ArraySpec.parse(dtype, [1])
    assert caught.value.code == "bad-dtype"


@pytest.mark.parametrize("shape", [[-1], [1.0], [True], "12", 3, None, {"a": 1}, [1] * (MAX_DIMENSIONS + 1), [[1]]])
def test_shapes_that_are_no_lists_of_sizes_are_refused(shape: object) -> None:
    with pytest.raises(ArrayError) as caught:
        ArraySpec.parse("<f4", shape)
    assert caught.value.code == "bad-shape"


@pytest.mark.parametrize("shape", [[1 << 41], [1 << 30, 1 << 30], [10**12, 0, 5], [10**400]])
def test_claims_beyond_reason_are_refused(shape: list[int]) -> None:
    with pytest.raises(ArrayError) as caught:
        ArraySpec.parse("<f4", shape)
    assert caught.value.code == "too-large"


def test_a_limit_names_the_array_that_exceeds_it() -> None:
    spec = ArraySpec("<f8", (100, 10))
    spec.require(8000)
    with pytest.raises(ArrayError, match=r"<f8 \[100, 10\] is larger than the 7999 bytes that are allowed"):
        spec.require(7999)


@pytest.mark.parametrize("array", [np.arange(6, dtype=">i4").reshape(2, 3).T, np.array(2.5, ">f8"), np.zeros((0, 3))])
def test_little_endian_arrays_keep_numbers_and_shape(array: np.ndarray) -> None:
    plain = little_endian(array)
    assert plain.flags.c_contiguous
    assert plain.dtype.str in DTYPES
    assert plain.shape == array.shape
    assert np.array_equal(plain, array)


def test_the_first_number_that_is_not_finite_is_named() -> None:
    array = np.ones((4, 3))
    array[2, 1:] = np.nan, np.inf
    with pytest.raises(ArrayError, match=r"element \[2, 1\] is nan"):
        require_finite(array)

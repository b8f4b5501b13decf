"""Numbers parsed from text equal those that Python parses; some texts that only Python accepts are refused."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marey_motion.formats.numeric_text import BadNumber, scan_numbers


def scan(text: bytes, width: int = 1, first_line: int = 1) -> np.ndarray:
    return scan_numbers(np.frombuffer(text, np.uint8), width, first_line).values


def same_bits(values: np.ndarray, expected: list[float]) -> bool:
    return np.array_equal(values.view(np.int64), np.array(expected, np.float64).view(np.int64))


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False)))
def test_shortest_representations_come_back_to_the_bit(values: list[float]) -> None:
    assert same_bits(scan(" ".join(map(repr, values)).encode()), values)


@given(st.lists(st.from_regex(r"\A[+-]?(?:[0-9]{1,25}\.?[0-9]{0,25}|\.[0-9]{1,25})(?:[eE][+-]?[0-9]{1,2})?\Z")))
def test_any_decimal_numeral_is_read_as_python_reads_it(numerals: list[str]) -> None:
    assert same_bits(scan("\t".join(numerals).encode()), [float(numeral) for numeral in numerals])


@pytest.mark.parametrize("sign", ["", "-", "+"])
@pytest.mark.parametrize("exponent", ["", "e-05", "E-7", "e-", "e-123", "e3"])
def test_numerals_of_every_length_are_read_as_python_reads_them(sign: str, exponent: str) -> None:
    # Eight characters are read at a time wherever the text does not end soon.
    digits = "98765432101234567890"
    for whole, decimals in itertools.product(range(20), range(20)):
        numeral = f"{sign}{digits[:whole]}.{digits[:decimals]}{exponent}"
        text = f" 1.5 {numeral} 2.5{40 * ' '}".encode()
        if whole + decimals and exponent != "e-":
            assert same_bits(scan(text), [1.5, float(numeral), 2.5]), numeral
        else:
            with pytest.raises(BadNumber):
                scan(text)


@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_lines_are_counted_whatever_ends_them(ending: str) -> None:
    with pytest.raises(BadNumber) as bad:
        scan(ending.join(["1 2", "", "3 x"]).encode(), first_line=10)
    assert (bad.value.line, bad.value.index, bad.value.in_line, bad.value.token) == (12, 3, 1, "x")


@pytest.mark.parametrize(
    "token", ["nan", "inf", "1e999", "1,5", "1_0", "0x1p3", ".", "-", "1e", "--1", "1.2.3", "1e-", "1.5-2", "é", "\x00"]
)
def test_what_is_no_finite_decimal_number_is_refused(token: str) -> None:
    with pytest.raises(BadNumber) as bad:
        scan(f"1 {token} 2".encode())
    with pytest.raises(BadNumber) as bad_far_from_the_end:
        scan(f"1 {token} 2{40 * ' '}".encode())
    assert vars(bad.value) == vars(bad_far_from_the_end.value)
    assert bad.value.index == 1


def test_the_first_line_of_another_width_is_reported() -> None:
    table = scan_numbers(np.frombuffer(b"1 2\n\n3 4\n5\n6", np.uint8), 2, 1)
    assert (table.rows, table.ragged_line, table.ragged_count) == (4, 4, 1)


def test_many_long_numerals_are_all_read() -> None:
    numerals = [f"0.{n:020d}1" for n in range(40_000)]
    assert same_bits(scan(" ".join(numerals).encode()), [float(numeral) for numeral in numerals])

"""Fast reading of plain decimal numbers, eight bytes of text at a time.

Files of motion consist almost only of numbers such as -12.345678 and 1.5e-05. A loop over their bytes is slow, because
the processor cannot predict where each number ends. The functions of this module load eight bytes as one integer (a
word), with the first byte of the text as the lowest, and process all bytes of a word at once.

The results are the same as those of `numeric_text.parse_number`, which reads all numbers that are not plain.
"""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled

_ONE, _EIGHT, _SEVEN_BYTES = np.uint64(1), np.uint64(8), np.uint64(56)
_LOW_BYTE = np.uint64(0xFF)
# One value in every byte of a word: 1, the highest bit, the digit 0, and what lifts numbers above 9 to the highest bit.
_ONES, _HIGH_BITS = np.uint64(0x0101010101010101), np.uint64(0x8080808080808080)
_ZERO_DIGITS, _ABOVE_NINE = np.uint64(0x3030303030303030), np.uint64(0x7676767676767676)
# One more than a space in every byte.
_PRINTED = np.uint64(0x2121212121212121)
# Factors and masks that add neighbouring digits to numbers of two, four and eight digits.
_PAIRS, _PAIR_MASK = np.uint64(1 + (10 << 8)), np.uint64(0x00FF00FF00FF00FF)
_FOURS, _FOUR_MASK = np.uint64(1 + (100 << 16)), np.uint64(0x0000FFFF0000FFFF)
_EIGHTS = np.uint64(1 + (10000 << 32))
_SPACE, _MINUS, _POINT = np.uint64(32), np.uint64(45), np.uint64(46)
# The bytes "E-", and the bits that they have in common with "e-".
_NEGATIVE_POWER, _IN_CAPITALS = np.uint64(0x2D45), np.uint64(0xFFDF)

_POWERS = np.array([10**k for k in range(9)], np.int64)
_EXACT_POWERS = np.array([float(f"1e{k}") for k in range(23)])
_LARGEST_EXACT_POWER = np.uint64(22)
# Integers of so many digits are exact doubles.
_EXACT_DIGITS = np.uint64(15)
# The last byte that is loaded is the 28th from the beginning of a number.
_BYTES_AHEAD = np.uint64(32)


@compiled
def _word(text, i):
    """Return the eight bytes from `i` on, which the compiler loads by one instruction."""
    return (
        np.uint64(text[i])
        | np.uint64(text[i + np.uint64(1)]) << np.uint64(8)
        | np.uint64(text[i + np.uint64(2)]) << np.uint64(16)
        | np.uint64(text[i + np.uint64(3)]) << np.uint64(24)
        | np.uint64(text[i + np.uint64(4)]) << np.uint64(32)
        | np.uint64(text[i + np.uint64(5)]) << np.uint64(40)
        | np.uint64(text[i + np.uint64(6)]) << np.uint64(48)
        | np.uint64(text[i + np.uint64(7)]) << np.uint64(56)
    )


@compiled
def _bytes_before(marks):
    """Count the bytes of an 8-byte integer before the first byte whose highest bit is set; 7 if there is none."""
    first = marks & (~marks + _ONE)
    return ((((first - _ONE) & _ONES) * _ONES) >> _SEVEN_BYTES) - _ONE


@compiled
def _length(first, second):
    """Count the bytes before the first white space in two integers of 8 bytes each; 15 if there is no white space."""
    # A borrow can mark only bytes after a white space, which do not matter.
    in_first = (first - _PRINTED) & ~first & _HIGH_BITS
    in_second = (second - _PRINTED) & ~second & _HIGH_BITS
    if in_first == 0:
        return _EIGHT + _bytes_before(in_second)
    return _bytes_before(in_first)


@compiled
def _digits(word):
    """Return the number of digits at the start of a word of eight bytes, and the integer that these digits form."""
    digits = word ^ _ZERO_DIGITS
    others = ((digits + _ABOVE_NINE) | digits) & _HIGH_BITS
    count = _EIGHT
    if others != 0:
        count = _bytes_before(others)
        # The digits become the last ones of eight, behind zeros; two shifts, because one of 64 bits is undefined.
        digits = (digits << _EIGHT) << (_SEVEN_BYTES - _EIGHT * count)
    digits = ((digits * _PAIRS) >> np.uint64(8)) & _PAIR_MASK
    digits = ((digits * _FOURS) >> np.uint64(16)) & _FOUR_MASK
    return count, np.int64((digits * _EIGHTS) >> np.uint64(32))


@compiled
def read_plain_numbers(text, values, i, count):
    """Read plain numbers separated by spaces, up to the first byte that is no space and begins no plain number.

    Reading also stops before a number that is too close to the end of the text, because bytes are read eight at a time.

    A plain number has at most 15 digits, with at most 8 before and 8 after the point, and fits in 15 bytes. It can have
    a minus sign before it and a negative power of ten after it.

    Parameters
    ----------
    text : (bytes,) uint8    the text
    values : (n,) float64    receives the numbers from `values[count]` on
    i : uint64    position of the first byte
    count : int    number of values that are already there

    Returns
    -------
    i : uint64    position of the first byte that was not read
    count : int    number of values that are there now
    """
    while i + _BYTES_AHEAD < text.size:
        word = _word(text, i)
        if word & _LOW_BYTE == _SPACE:
            i += _ONE
            continue
        # Where the number ends is found apart from its value, so that the processor need not wait for the value before
        # it begins with the next number.
        end = i + _length(word, _word(text, i + _EIGHT))
        negative = word & _LOW_BYTE == _MINUS
        at = i + np.uint64(negative)
        digits, mantissa = _digits(_word(text, at))
        at += digits
        power = np.uint64(0)
        if _word(text, at) & _LOW_BYTE == _POINT:
            power, decimals = _digits(_word(text, at + _ONE))
            at += _ONE + power
            mantissa = mantissa * _POWERS[power] + decimals
        digits += power
        if _word(text, at) & _IN_CAPITALS == _NEGATIVE_POWER:
            length, exponent = _digits(_word(text, at + np.uint64(2)))
            at += np.uint64(2) + length
            power += np.uint64(exponent)
            if length == 0:
                break
        # `end` is wrong if the two words have no white space.
        if at != end or _word(text, at) & _LOW_BYTE > _SPACE:
            break
        if digits == 0 or digits > _EXACT_DIGITS or power > _LARGEST_EXACT_POWER:
            break
        value = np.float64(mantissa) / _EXACT_POWERS[power]
        values[count] = -value if negative else value
        count += 1
        i = end
    return i, count

"""Fast parsing of decimal numbers in text, with exactly the results of Python's `float`.

If the digits of a number form an integer of at most 2**53, and its power of ten is at most 10**22, the number is the
correctly rounded product or quotient of two exact doubles (Clinger, "How to read floating point numbers accurately",
PLDI 1990). All other numbers, which are rare in real files, are parsed by `float`. `plain_numbers` reads the usual
numbers faster, with the same results.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.formats.plain_numbers import read_plain_numbers
from marey_motion.kernels import compiled

# What `parse_number` found, besides a value.
EXACT, LONG, MALFORMED = 0, 1, 2

_EXACT_POWERS = np.array([float(f"1e{k}") for k in range(23)])
_LARGEST_EXACT = 1 << 53
_ONE = np.uint64(1)
_LINE_FEED = np.uint8(10)
LONG_TOKENS_PER_CALL = 1 << 14

# Slots of the scanner's state, which survives between calls of the kernel.
_POSITION, _LINE, _VALUES, _IN_LINE, _ROWS, _RAGGED_LINE, _RAGGED_COUNT, _LONG_TOKENS = range(8)


@dataclass(frozen=True)
class NumberTable:
    """Numbers of a text block, row after row.

    `values` is flat; `rows` is the number of lines with numbers. `ragged_line` is the first line, counted from 1, that
    does not have the expected number of values, 0 if there is no such line; `ragged_count` is the number of values in
    this line. `last_line` is the last line read.
    """

    values: NDArray[np.float64]
    rows: int
    ragged_line: int
    ragged_count: int
    last_line: int


class BadNumber(ValueError):
    """A token that is not a finite decimal number.

    `token` is its text, `line` the number of its line, `index` the number of values before it in the block, and
    `in_line` the number of values before it in its line.
    """

    def __init__(self, token: str, line: int, index: int, in_line: int) -> None:
        super().__init__(f"{token!r} in line {line} is not a finite decimal number")
        self.token = token
        self.line = line
        self.index = index
        self.in_line = in_line


@compiled
def parse_number(text, start):
    """Read one decimal number at `text[start:]`. The text must end in a line feed, since its length is not checked.

    Positions are unsigned, because signed positions would need a test for negative indices at every byte.

    Parameters
    ----------
    text : (bytes,) uint8    the text
    start : int    position of the first byte

    Returns
    -------
    kind : int    `EXACT`; `LONG` for a number that only `float` parses exactly; `MALFORMED` for any other text
    value : float    valid only when `kind` is `EXACT`
    stop : int    position after the number; for `MALFORMED`, of the first byte that cannot belong to a number
    """
    i = np.uint64(start)
    negative = text[i] == 45
    if negative or text[i] == 43:
        i += _ONE
    first_digit = i
    mantissa = np.int64(0)
    digit = np.uint8(text[i] - 48)
    while digit < 10:
        mantissa = mantissa * 10 + digit
        i += _ONE
        digit = np.uint8(text[i] - 48)
    digits = np.int64(i - first_digit)
    exponent = np.int64(0)
    if text[i] == 46:
        i += _ONE
        first_decimal = i
        digit = np.uint8(text[i] - 48)
        while digit < 10:
            mantissa = mantissa * 10 + digit
            i += _ONE
            digit = np.uint8(text[i] - 48)
        exponent = np.int64(first_decimal) - np.int64(i)
        digits -= exponent
    well_formed = digits > 0
    if well_formed and (text[i] == 101 or text[i] == 69):
        i += _ONE
        falling = text[i] == 45
        if falling or text[i] == 43:
            i += _ONE
        first_power = i
        power = np.int64(0)
        digit = np.uint8(text[i] - 48)
        while digit < 10:
            if power < 100000:
                power = power * 10 + digit
            i += _ONE
            digit = np.uint8(text[i] - 48)
        well_formed = i > first_power
        exponent += -power if falling else power
    if not well_formed or text[i] > 32:
        return MALFORMED, 0.0, i
    if digits > 18 or mantissa > _LARGEST_EXACT or exponent > 22 or exponent < -22:
        return LONG, 0.0, i
    value = np.float64(mantissa)
    if exponent < 0:
        value /= _EXACT_POWERS[-exponent]
    else:
        value *= _EXACT_POWERS[exponent]
    return EXACT, -value if negative else value, i


@compiled
def _scan(text, width, values, long_tokens, state):
    """Read numbers until the text ends or `long_tokens` is full, and return 0; return 1 at a malformed number."""
    i, end = np.uint64(state[_POSITION]), np.uint64(text.size)
    line, count, in_line, rows = state[_LINE], state[_VALUES], state[_IN_LINE], state[_ROWS]
    long_count = 0
    malformed = 0
    while i < end:
        i, now = read_plain_numbers(text, values, i, count)
        in_line += now - count
        count = now
        byte = text[i]
        if byte == 32 or byte == 9 or byte == 11 or byte == 12:
            i += _ONE
        elif byte == 10 or byte == 13:
            if in_line > 0:
                rows += 1
                if in_line != width and state[_RAGGED_LINE] == 0:
                    state[_RAGGED_LINE] = line
                    state[_RAGGED_COUNT] = in_line
                in_line = 0
            line += 1
            i += _ONE
            if byte == 13 and i < end and text[i] == 10:
                i += _ONE
        else:
            if long_count == long_tokens.shape[0]:
                break
            kind, value, stop = parse_number(text, i)
            if kind == MALFORMED:
                malformed = 1
                break
            if kind == LONG:
                token = long_tokens[long_count]
                token[0], token[1], token[2], token[3], token[4] = i, stop, line, count, in_line
                long_count += 1
            values[count] = value
            count += 1
            in_line += 1
            i = stop
    state[_POSITION], state[_LINE], state[_VALUES], state[_IN_LINE], state[_ROWS] = i, line, count, in_line, rows
    state[_LONG_TOKENS] = long_count
    return malformed


def ending_in_a_line(text: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Append a line feed to a text that does not end in one.

    Parameters
    ----------
    text : (bytes,) uint8    the text

    Returns
    -------
    (bytes,) uint8    the text itself, or a copy
    """
    return text if text.size and text[-1] == _LINE_FEED else np.append(text, _LINE_FEED)


def scan_numbers(text: NDArray[np.uint8], width: int, first_line: int) -> NumberTable:
    """Read a block of numbers separated by white space, one row per line.

    Parameters
    ----------
    text : (bytes,) uint8    the text
    width : int    expected number of values in a line; lines with more or fewer values raise no error, but the first
        such line is reported
    first_line : int    number of the first line of `text`, from 1

    Returns
    -------
    NumberTable    the numbers, and the first line with more or fewer values than `width`

    Raises
    ------
    BadNumber    at the first token that is not a finite decimal number
    """
    text = ending_in_a_line(text)
    # Sized by what the text can hold, never by what a header declares; untouched pages cost nothing.
    values = np.empty((text.size + 1) // 2, np.float64)
    long_tokens = np.empty((LONG_TOKENS_PER_CALL, 5), np.int64)
    state = np.zeros(8, np.int64)
    state[_LINE] = first_line
    while state[_POSITION] < text.size:
        malformed = _scan(text, width, values, long_tokens, state)
        if state[_LONG_TOKENS]:
            _read_long_tokens(text, long_tokens[: state[_LONG_TOKENS]], values)
            state[_LONG_TOKENS] = 0
        if malformed:
            raise _bad_token_at(text, state)
    return NumberTable(
        values=values[: state[_VALUES]],
        rows=int(state[_ROWS]),
        ragged_line=int(state[_RAGGED_LINE]),
        ragged_count=int(state[_RAGGED_COUNT]),
        last_line=int(state[_LINE]) - 1,
    )


def _read_long_tokens(text: NDArray[np.uint8], tokens: NDArray[np.int64], values: NDArray[np.float64]) -> None:
    characters = text.data
    numbers = np.array([float(characters[start:stop]) for start, stop in tokens[:, :2].tolist()])
    infinite = np.flatnonzero(np.isinf(numbers))
    if infinite.size:
        start, stop, line, index, in_line = tokens[infinite[0]].tolist()
        raise BadNumber(excerpt(text[start:stop].tobytes()), line, index, in_line)
    values[tokens[:, 3]] = numbers


def _bad_token_at(text: NDArray[np.uint8], state: NDArray[np.int64]) -> BadNumber:
    start = int(state[_POSITION])
    words = text[start : start + 64].tobytes().split(maxsplit=1)
    return BadNumber(excerpt(words[0]), int(state[_LINE]), int(state[_VALUES]), int(state[_IN_LINE]))


def excerpt(token: bytes) -> str:
    """Shorten a token for messages: one line, printable.

    Parameters
    ----------
    token : bytes    the token

    Returns
    -------
    str    the first 40 bytes as text, with an ellipsis if the token is longer
    """
    text = token[:40].decode("utf-8", "replace")
    shown = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    return shown + ("…" if len(token) > 40 else "")

"""Scanner of the frames of an AMC file.

A frame is a line with its number, then one line per bone, in any order: the bone's name and one value per degree of
freedom.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from marey_motion.formats.asf import AsfSkeleton, Bone
from marey_motion.formats.numeric_text import EXACT, LONG, LONG_TOKENS_PER_CALL, ending_in_a_line, excerpt, parse_number
from marey_motion.formats.text_lines import TextLines, number_problem
from marey_motion.kernels import compiled

# What stopped the scanner.
_END, _BUFFER_FULL, _BAD_NUMBER, _UNKNOWN_BONE, _WRONG_WIDTH, _REPEATED_BONE, _MISSING_BONE = range(7)
# Slots of its state, which survives between calls; _BONE and _FOUND describe the line it stopped at.
_POSITION, _LINE, _FRAME, _SEEN, _NUMBER, _GAPS, _BONE, _FOUND, _LONG_TOKENS = range(9)


@dataclass(frozen=True)
class BoneTable:
    """Bones as arrays for compiled code: concatenated names, end of each name, first column of each bone.

    `by_name` are the indices of the bones in the order of their names.
    """

    names: NDArray[np.uint8]
    name_ends: NDArray[np.int64]
    first_columns: NDArray[np.int64]
    by_name: NDArray[np.int64]

    @classmethod
    def of(cls, bones: list[Bone]) -> BoneTable:
        """Make the table of the bones of a skeleton.

        Parameters
        ----------
        bones : list of Bone    bones in the order of the skeleton

        Returns
        -------
        BoneTable    names and columns as arrays
        """
        names = [bone.written_name for bone in bones]
        widths = [len(bone.channels) for bone in bones]
        return cls(
            np.frombuffer(b"".join(names), np.uint8),
            np.cumsum([len(name) for name in names]),
            np.cumsum([0, *widths]),
            np.array(sorted(range(len(names)), key=names.__getitem__), np.int64),
        )


def scan_frames(lines: TextLines, skeleton: AsfSkeleton) -> tuple[NDArray[np.float64], int]:
    """Read every frame from the current line on.

    Parameters
    ----------
    lines : TextLines    lines of the file
    skeleton : AsfSkeleton    bones with C channels in all

    Returns
    -------
    values : (F, C) float64    channels of all bones side by side, in degrees or radians and in the file's unit of
        length
    gaps : int    number of gaps in the numbering of the frames

    Raises
    ------
    FormatError    if the file is invalid; the error names the line and the bone
    """
    text = ending_in_a_line(np.frombuffer(lines.data, np.uint8))
    table = BoneTable.of(skeleton.bones)
    # Sized by what the text can hold: a frame has a number, and a line for each bone with channels, but no others.
    lengths, widths = np.diff(table.name_ends, prepend=0), np.diff(table.first_columns)
    shortest = 2 + int(np.sum((lengths + 1 + 2 * widths)[widths > 0]))
    called = table.names, table.name_ends, table.by_name
    values = np.zeros(((len(lines.data) - lines.position) // shortest + 1, int(table.first_columns[-1])))
    seen = np.full(len(skeleton.bones), -1, np.int64)
    long_tokens = np.empty((LONG_TOKENS_PER_CALL, 5), np.int64)
    state = np.zeros(9, np.int64)
    state[_POSITION], state[_LINE], state[_FRAME] = lines.position, lines.number + 1, -1
    stopped = _BUFFER_FULL
    while stopped == _BUFFER_FULL:
        stopped = _scan(text, called, table.first_columns, values, seen, long_tokens, state)
        lines.number = int(state[_LINE])
        _read_long_tokens(text, long_tokens[: state[_LONG_TOKENS]], values, skeleton, lines)
        state[_LONG_TOKENS] = 0
    if stopped != _END:
        _fail(stopped, lines, skeleton, seen, state)
    return values[: state[_FRAME] + 1], int(state[_GAPS])


@compiled
def _scan(text, called, first_columns, values, seen, long_tokens, state):
    end = text.size
    bones = first_columns.size - 1
    moving = np.sum(first_columns[1:] > first_columns[:-1])
    while True:
        i = _next_word(text, state)
        if i >= end:
            return _END if state[_SEEN] == moving else _MISSING_BONE
        stop = i
        while stop < end and text[stop] > 32:
            stop += 1
        if text[i] == 35:
            while stop < end and text[stop] != 10 and text[stop] != 13:
                stop += 1
        elif _is_frame_number(text, i, stop):
            if state[_FRAME] >= 0 and state[_SEEN] < moving:
                return _MISSING_BONE
            _begin_frame(text, i, stop, state)
        else:
            bone = _bone_called(text[i:stop], called, state[_BONE])
            if bone < 0 or state[_FRAME] < 0:
                return _UNKNOWN_BONE
            state[_BONE] = bone
            if seen[bone] == state[_FRAME]:
                return _REPEATED_BONE
            width = first_columns[bone + 1] - first_columns[bone]
            if state[_LONG_TOKENS] + width > long_tokens.shape[0]:
                return _BUFFER_FULL
            stop = _read_bone(text, stop, first_columns, values, long_tokens, state)
            if stop < 0:
                return _BAD_NUMBER
            if state[_FOUND] != width:
                return _WRONG_WIDTH
            seen[bone] = state[_FRAME]
            state[_SEEN] += width > 0
            state[_BONE] = (bone + 1) % bones
        state[_POSITION] = stop


@compiled
def _next_word(text, state):
    """Skip to the next word and return its position; the position and the line number in `state` are updated."""
    i = state[_POSITION]
    while i < text.size and text[i] <= 32:
        if text[i] == 10 or (text[i] == 13 and not (i + 1 < text.size and text[i + 1] == 10)):
            state[_LINE] += 1
        i += 1
    state[_POSITION] = i
    return i


@compiled
def _is_frame_number(text, start, stop):
    for i in range(start, stop):
        if not 48 <= text[i] <= 57:
            return False
    return stop - start <= 18


@compiled
def _begin_frame(text, start, stop, state):
    number = np.int64(0)
    for i in range(start, stop):
        number = number * 10 + np.uint8(text[i] - 48)
    if state[_FRAME] >= 0 and number != state[_NUMBER] + 1:
        state[_GAPS] += 1
    state[_NUMBER] = number
    state[_FRAME] += 1
    state[_SEEN] = 0
    state[_BONE] = 0


@compiled
def _bone_called(word, called, expected):
    """Return the index of the bone with the name `word`, or -1.

    Most files list the bones in the order of the skeleton, so `expected` is compared first. The other bones are found
    by bisection of the sorted names.
    """
    names, name_ends, by_name = called
    if _compare(word, names, name_ends, expected) == 0:
        return expected
    low, high = 0, by_name.size
    while low < high:
        middle = (low + high) // 2
        order = _compare(word, names, name_ends, by_name[middle])
        if order == 0:
            return by_name[middle]
        if order < 0:
            high = middle
        else:
            low = middle + 1
    return -1


@compiled
def _compare(word, names, name_ends, bone):
    """Return a number below, equal to or above 0 if `word` is before, equal to or after the name of a bone."""
    first = name_ends[bone - 1] if bone > 0 else 0
    length = name_ends[bone] - first
    for k in range(min(word.size, length)):
        if word[k] != names[first + k]:
            return np.int64(word[k]) - np.int64(names[first + k])
    return word.size - length


@compiled
def _read_bone(text, i, first_columns, values, long_tokens, state):
    """Read the numbers of a bone, from position `i` to the end of the line, into `values`.

    Returns the position after the numbers, or -1 if a number is malformed.
    """
    bone, frame = state[_BONE], state[_FRAME]
    state[_FOUND] = 0
    while i < text.size and text[i] != 10 and text[i] != 13:
        if text[i] <= 32:
            i += 1
            continue
        kind, value, after = parse_number(text, i)
        stop = np.int64(after)
        if kind != EXACT and kind != LONG:
            state[_POSITION] = i
            return -1
        column = first_columns[bone] + state[_FOUND]
        if column < first_columns[bone + 1]:
            values[frame, column] = value
            if kind == LONG:
                row = long_tokens[state[_LONG_TOKENS]]
                row[0], row[1], row[2], row[3], row[4] = i, stop, state[_LINE], frame, column
                state[_LONG_TOKENS] += 1
        state[_FOUND] += 1
        i = stop
    return i


def _read_long_tokens(
    text: NDArray[np.uint8],
    tokens: NDArray[np.int64],
    values: NDArray[np.float64],
    skeleton: AsfSkeleton,
    lines: TextLines,
) -> None:
    for start, stop, line, frame, column in tokens.tolist():
        value = float(text[start:stop].tobytes())
        if abs(value) == float("inf"):
            ends = np.cumsum([len(bone.channels) for bone in skeleton.bones])
            bone = int(np.searchsorted(ends, column, side="right"))
            lines.number = line
            problem = number_problem(excerpt(text[start:stop].tobytes()))
            raise lines.error(problem, code="bad-number", joint=skeleton.bones[bone].name)
        values[frame, column] = value


def _fail(
    stopped: int, lines: TextLines, skeleton: AsfSkeleton, seen: NDArray[np.int64], state: NDArray[np.int64]
) -> NoReturn:
    """Raise the error that stopped the scanner, with the line where the scanner stopped."""
    bone = skeleton.bones[state[_BONE]]
    word = lines.data[state[_POSITION] : state[_POSITION] + 64].split(maxsplit=1)[:1] or [b""]
    if stopped == _BAD_NUMBER:
        raise lines.error(number_problem(excerpt(word[0])), code="bad-number", joint=bone.name)
    if stopped == _UNKNOWN_BONE:
        raise lines.error(
            f"the skeleton has no bone {excerpt(word[0])!r}; use the ASF that belongs to this AMC", code="unknown-bone"
        )
    if stopped == _REPEATED_BONE:
        raise lines.error(
            f"the bone {bone.name!r} has two lines in frame {state[_NUMBER]}; remove one", joint=bone.name
        )
    if stopped == _WRONG_WIDTH:
        cut = state[_FOUND] < len(bone.channels) and not lines.data[state[_POSITION] :].strip(b"\r\n\t ").count(b"\n")
        raise lines.error(
            f"the bone {bone.name!r} has {state[_FOUND]} values for {len(bone.channels)} degrees of freedom"
            + (
                "; the file is cut off, so copy or export it again" if cut else "; use the ASF that belongs to this AMC"
            ),
            code="file-truncated" if cut else "frame-width",
            joint=bone.name,
        )
    moving = np.array([len(bone.channels) > 0 for bone in skeleton.bones])
    missing = skeleton.bones[int(np.argmax(moving & (seen < state[_FRAME])))]
    at_end = not lines.data[state[_POSITION] :].strip()
    raise lines.error(
        f"frame {state[_NUMBER]} has no line for the bone {missing.name!r}"
        + ("; the file is cut off, so copy or export it again" if at_end else "; add the line"),
        code="file-truncated" if at_end else "frame-width",
        joint=missing.name,
    )

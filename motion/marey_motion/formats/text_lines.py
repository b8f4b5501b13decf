"""Lines of a text file with line numbers, and the errors that all text readers share."""

from __future__ import annotations

import re
from collections.abc import Iterator

from marey_motion.errors import FormatError
from marey_motion.formats.numeric_text import excerpt
from marey_schemas.wording import counted

_LINE_END = re.compile(rb"\r\n|\n|\r")
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_WIDE_MARKS = (b"\xff\xfe", b"\xfe\xff")
_EVERY_OTHER_ZERO = b"\0\0"
MOST_CACHED_BYTES = 1 << 18
"""Greatest size in bytes of the text of a skeleton whose parsed form is cached."""


class TextLines:
    """Numbered lines of `data`, with LF, CRLF or CR line ends, read on demand.

    Attributes
    ----------
    number : number of the line last returned, from 1; 0 before the first
    position : offset of the first byte after that line and its line end
    """

    def __init__(self, data: bytes, file: str) -> None:
        if data.startswith(_WIDE_MARKS) or _EVERY_OTHER_ZERO in (data[0:3:2], data[1:4:2]):
            raise FormatError("the file is text in UTF-16; save it as UTF-8", code="text-encoding", file=file, line=1)
        # Old editors ended a file with Ctrl-Z, and old file systems filled it up with zeros.
        self.data = data.rstrip(b"\0\x1a")
        self.file = file
        self.number = 0
        self.position = len(_BYTE_ORDER_MARK) if data.startswith(_BYTE_ORDER_MARK) else 0

    def __iter__(self) -> Iterator[bytes]:
        """Yield each remaining line that is not blank, without surrounding white space."""
        while (line := self.next()) is not None:
            if line:
                yield line

    def next(self) -> bytes | None:
        """Read the next line.

        Returns
        -------
        bytes or None    the line without surrounding white space, None at the end of the file
        """
        if self.position >= len(self.data):
            return None
        end = _LINE_END.search(self.data, self.position)
        start, self.position = self.position, end.end() if end else len(self.data)
        self.number += 1
        return self.data[start : end.start() if end else None].strip()

    def error(self, message: str, *, code: str | None = None, joint: str | None = None) -> FormatError:
        """Make an error that points at the current line.

        Parameters
        ----------
        message : str    the problem and its remedy
        code : str, optional    machine-readable code of the error
        joint : str, optional    name of the joint that was being read

        Returns
        -------
        FormatError    the error, to be raised
        """
        return FormatError(message, code=code, file=self.file, line=max(self.number, 1), joint=joint)

    def numbers(self, words: list[bytes], count: int, what: str, joint: str | None = None) -> list[float]:
        """Parse words as finite decimal numbers, and check that there are exactly `count` of them.

        Parameters
        ----------
        words : list of bytes    the words
        count : int    required number of words
        what : str    name of the value, for messages
        joint : str, optional    name of the joint, for messages

        Returns
        -------
        list of float    the numbers

        Raises
        ------
        FormatError    if the number of words differs, or a word is not a finite decimal number
        """
        if len(words) != count:
            raise self.error(f"{what} has {counted(len(words), 'value')}, but {count} are needed", joint=joint)
        return [self.number_in(word, what, joint) for word in words]

    def number_in(self, word: bytes, what: str, joint: str | None = None) -> float:
        """Parse one finite decimal number.

        Parameters
        ----------
        word : bytes    the word
        what : str    name of the value, for messages
        joint : str, optional    name of the joint, for messages

        Returns
        -------
        float    the number

        Raises
        ------
        FormatError    if the word is not a finite decimal number
        """
        value = read_number(word)
        if value is None:
            raise self.error(f"{what}: {number_problem(excerpt(word))}", code="bad-number", joint=joint)
        return value


def read_number(word: bytes) -> float | None:
    """Parse a finite decimal number as `float` does, but refuse "nan" and "1_0", which `float` accepts.

    Parameters
    ----------
    word : bytes    the word

    Returns
    -------
    float or None    the number; None if the word is not such a number
    """
    if not word or not _NUMBER.fullmatch(word):
        return None
    value = float(word)
    return value if abs(value) != float("inf") else None


_NUMBER = re.compile(rb"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?")
_NOT_FINITE = re.compile(r"[+-]?(?:nan|inf|infinity|\d+(?:\.\d*)?#\w+)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?,?")


def number_problem(word: str) -> str:
    """Explain why a word is not a finite decimal number, and what to do about it if the cause is known.

    Parameters
    ----------
    word : str    the word

    Returns
    -------
    str    the explanation, for an error message
    """
    if _NOT_FINITE.match(word):
        return f"{word} is not finite; repair or cut these frames"
    if _DECIMAL_COMMA.fullmatch(word):
        return f"{word} has a decimal comma; write numbers with a point"
    if _NUMBER.fullmatch(word.encode("utf-8", "replace")):
        return f"{word} is too large for a number"
    return f"{word!r} is not a number"


def decode_name(name: bytes) -> str:
    """Decode a joint name as UTF-8, or else as Latin-1; unprintable characters become spaces.

    Parameters
    ----------
    name : bytes    the name in the file

    Returns
    -------
    str    the name
    """
    try:
        text = name.decode("utf-8")
    except UnicodeDecodeError:
        text = name.decode("latin-1")
    return "".join(character if character.isprintable() else " " for character in text).strip()

"""Types of texts with a required form, such as names, paths and digests, for fields of documents."""

import re
from typing import Annotated

from pydantic import AfterValidator, StringConstraints

FORMS: dict[str, str] = {}
"""Explanation of each pattern for error texts, by the pattern; it continues the words "the text must"."""


def form(pattern: str, words: str) -> str:
    """Register the explanation of a pattern in `FORMS`, and return the pattern."""
    FORMS[pattern] = words
    return pattern


_SLUG_WORDS = "have at most 64 lower-case letters, digits, {signs}, and begin and end with a letter or a digit"
_NO_CONTROLS = "no control characters, such as line breaks, and not be empty"
_ONE_LINE = f"contain {_NO_CONTROLS}"
SLUG = form(r"^[a-z0-9](?:[a-z0-9_-]{0,62}[a-z0-9])?$", _SLUG_WORDS.format(signs="- and _"))
"""Pattern of names that are parts of URLs."""
USER = form(r"^[a-z0-9](?:[a-z0-9._-]{0,62}[a-z0-9])?$", _SLUG_WORDS.format(signs="dots, - and _"))
_NAME = form(r"^[^/\x00-\x1f\x7f]+$", f"contain no slash and {_NO_CONTROLS}")
_PATH = form(
    r"^(?:[^/\x00-\x1f\x7f]{1,255}(?:/[^/\x00-\x1f\x7f]{1,255})*)?$",
    "be names joined by single slashes, without a slash at its beginning or end",
)
_TAG = form(r"^[^,\x00-\x1f\x7f]+$", f"contain no comma and {_NO_CONTROLS}")
_SUFFIX = form(r"^[^/\x00-\x1f\x7f]*$", "contain no slash and no control characters, such as line breaks")
_SHOWN = form(r"^[^\x00-\x1f\x7f-\x9f]+$", _ONE_LINE)
LINE = form(r"^[^\x00-\x1f\x7f]+$", _ONE_LINE)
"""Pattern of one line of text."""
DIGEST_PATTERN = form(r"^sha256:[0-9a-f]{64}$", "be sha256: followed by 64 hexadecimal digits in lower case")
REF = form(
    r"^[A-Za-z0-9](?:[A-Za-z0-9._-]{0,126}[A-Za-z0-9])?$",
    "have at most 128 letters, digits, dots, - and _, and begin and end with a letter or a digit",
)
"""Pattern of names of branches and tags."""

ProjectName = Annotated[str, StringConstraints(pattern=SLUG)]
"""Name of a project: lower-case letters, digits, `-` and `_`; the name is part of URLs."""

UserName = Annotated[str, StringConstraints(pattern=USER)]

MAX_NAME_LENGTH = 255

ItemName = Annotated[str, StringConstraints(min_length=1, max_length=MAX_NAME_LENGTH, pattern=_NAME)]
"""Name of an item: any printable text without a slash."""

NameSuffix = Annotated[str, StringConstraints(max_length=64, pattern=_SUFFIX)]
"""Text that can be appended to a name."""

CollectionPath = Annotated[str, StringConstraints(max_length=1024, pattern=_PATH)]
"""Path of a collection: names joined by `/`, without a leading or trailing slash; the empty path is the root."""


def _without_dots(path: str) -> str:
    """Refuse . and .. in a path. They would refer to other folders in a file system, but would be names here."""
    if {".", ".."} & set(path.split("/")):
        raise ValueError(
            "the path of a folder must not contain . or ..; write the names of the folders, "
            "beginning at the top of the project"
        )
    return path


ReceivingPath = Annotated[CollectionPath, AfterValidator(_without_dots)]
"""Path of a collection that receives items; no name in it is `.` or `..`."""

Tag = Annotated[str, StringConstraints(min_length=1, max_length=64, pattern=_TAG)]

MOST_TAGS = 64
"""Greatest number of tags of an item."""

Digest = Annotated[str, StringConstraints(pattern=DIGEST_PATTERN)]
"""Digest of bytes: `sha256:` and 64 hexadecimal digits."""

ShownText = Annotated[str, StringConstraints(min_length=1, pattern=_SHOWN)]
"""Text of a program that is shown to people. It contains no control characters, which could change a terminal."""

PartName = Annotated[str, StringConstraints(min_length=1, max_length=64)]

Message = Annotated[str, StringConstraints(max_length=2000)]

JointName = Annotated[str, StringConstraints(min_length=1, max_length=1024)]

MAX_LABEL_LENGTH = 255

Label = Annotated[str, StringConstraints(min_length=1, max_length=MAX_LABEL_LENGTH)]

LayerName = Annotated[str, StringConstraints(min_length=1, max_length=64, pattern=_NAME)]

ItemId = Annotated[str, StringConstraints(min_length=1, max_length=64)]

TrialName = Annotated[str, StringConstraints(min_length=1, max_length=100)]

_DIGEST = re.compile(DIGEST_PATTERN)


def is_digest(text: str) -> bool:
    """Return whether a text is the digest of bytes."""
    return _DIGEST.fullmatch(text) is not None


def base_name(file: str) -> str:
    """Return the name of a file without its folders; both `/` and `\\` separate folders."""
    return file.replace("\\", "/").rpartition("/")[2]

"""Types of constrained strings for documents."""

import re
from typing import Annotated

from pydantic import StringConstraints

ProjectName = Annotated[str, StringConstraints(pattern=r"^[a-z0-9](?:[a-z0-9_-]{0,62}[a-z0-9])?$")]
"""Name of a project: lower-case letters, digits, `-` and `_`; the name is part of URLs."""

UserName = Annotated[str, StringConstraints(pattern=r"^[a-z0-9](?:[a-z0-9._-]{0,62}[a-z0-9])?$")]

MAX_NAME_LENGTH = 255

ItemName = Annotated[str, StringConstraints(min_length=1, max_length=MAX_NAME_LENGTH, pattern=r"^[^/\x00-\x1f\x7f]+$")]
"""Name of an item: any printable text without a slash."""

NameSuffix = Annotated[str, StringConstraints(max_length=64, pattern=r"^[^/\x00-\x1f\x7f]*$")]
"""Text that can be appended to a name."""

CollectionPath = Annotated[
    str, StringConstraints(max_length=1024, pattern=r"^(?:[^/\x00-\x1f\x7f]{1,255}(?:/[^/\x00-\x1f\x7f]{1,255})*)?$")
]
"""Path of a collection: names joined by `/`, without a leading or trailing slash; the empty path is the root."""

Tag = Annotated[str, StringConstraints(min_length=1, max_length=64, pattern=r"^[^,\x00-\x1f\x7f]+$")]

MOST_TAGS = 64
"""Greatest number of tags of an item."""

DIGEST_PATTERN = r"^sha256:[0-9a-f]{64}$"
Digest = Annotated[str, StringConstraints(pattern=DIGEST_PATTERN)]
"""Digest of bytes: `sha256:` and 64 hexadecimal digits."""

ShownText = Annotated[str, StringConstraints(min_length=1, pattern=r"^[^\x00-\x1f\x7f-\x9f]+$")]
"""Text of a program that is shown to people: without control characters, with which it could change a terminal."""

PartName = Annotated[str, StringConstraints(min_length=1, max_length=64)]

Message = Annotated[str, StringConstraints(max_length=2000)]

JointName = Annotated[str, StringConstraints(min_length=1, max_length=1024)]

MAX_LABEL_LENGTH = 255

Label = Annotated[str, StringConstraints(min_length=1, max_length=MAX_LABEL_LENGTH)]

LayerName = Annotated[str, StringConstraints(min_length=1, max_length=64, pattern=r"^[^/\x00-\x1f\x7f]+$")]

ItemId = Annotated[str, StringConstraints(min_length=1, max_length=64)]

TrialName = Annotated[str, StringConstraints(min_length=1, max_length=100)]

_DIGEST = re.compile(DIGEST_PATTERN)


def is_digest(text: str) -> bool:
    """Return whether a text is the digest of bytes."""
    return _DIGEST.fullmatch(text) is not None


def base_name(file: str) -> str:
    """Return the name of a file without its folders; both `/` and `\\` separate folders."""
    return file.replace("\\", "/").rpartition("/")[2]

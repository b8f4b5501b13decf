"""Short names of tests whose parameters are long texts.

By default, pytest writes a whole text or bytes object into the name of the test. With a parameter of 2 MB, the name had
9 MB. Each process sends all names to the main process, which compares them.
"""

from __future__ import annotations

LONGEST = 200
"""Greatest length of a text or bytes object that is part of the name of a test."""


def pytest_make_parametrize_id(val: object, argname: str) -> str | None:
    """Name a long text by its parameter and its length; return None for other values, which pytest names.

    If names are equal, pytest appends numbers.
    """
    if isinstance(val, str | bytes) and len(val) > LONGEST:
        return f"{argname} of {len(val)} {'bytes' if isinstance(val, bytes) else 'characters'}"
    return None

"""Detection of credentials in records of work, by the words in the names of fields, variables and options."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

_WORDS = {
    "token", "password", "passwords", "passwd", "pwd", "pass", "passphrase", "secret", "secrets", "credential",
    "credentials", "authorization", "auth", "apikey", "apikeys", "accesskey", "accesskeys", "privatekey", "privatekeys",
}  # fmt: skip
_PAIRS = {(first, key) for first in ("api", "access", "private") for key in ("key", "keys")}
_WHOLE = ("tokens",)  # alone, for `n_tokens` is a number of words
_HINTS = ("token", "pass", "pwd", "secret", "credential", "auth", "key", "bearer", "@")
"""Every text that contains a credential contains one of these strings, if converted to lower case."""
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
# Quantifiers are possessive, so that the search takes linear time.
_NAME = re.compile(r"-{0,2}\w[\w.-]*+")
_ASSIGNED = re.compile(r"""(?<![\w.-])(-{0,2}\w[\w.-]*+)["']?+\s*+[=:]\s*+["']?+(?=([^\s"',;&]{1,40}+))""")
_OPTION = re.compile(r"""(?<![\w.-])(--?\w[\w.-]*+)\s++["']?+([^\s"'-][^\s"']*+)""")
_IN_URL = re.compile(r"://[^\s/:@]*+:[^\s/@]++@")
_BEARER = re.compile(r"\bbearer\s++\S", re.IGNORECASE)


def is_secret_name(name: object) -> bool:
    """Check whether the name of a field, a variable or an option is that of a credential.

    Parameters
    ----------
    name : object    the name; a value that is not a text is never the name of a credential

    Returns
    -------
    bool    True for names such as `apiKey`, `DB_PASSWORD` and `--token`, but not for `tokenizer`

    Examples
    --------
    >>> [is_secret_name(name) for name in ("apiKey", "tokenizer")]
    [True, False]
    """
    return isinstance(name, str) and _is_secret(_words_of(name))


def has_text(value: Any) -> bool:
    """Check whether a value is, or contains at any depth, a text that is not empty; bytes count as a text.

    Parameters
    ----------
    value : object    decoded value

    Returns
    -------
    bool    True if there is a text
    """
    waiting = [value]
    while waiting:
        one = waiting.pop()
        if isinstance(one, (str, bytes)) and one:
            return True
        if isinstance(one, Mapping):
            waiting.extend(one.values())
        elif isinstance(one, list):
            waiting.extend(one)
    return False


def contains_credential(text: str) -> bool:
    """Check whether a text contains a credential: `TOKEN=abc`, `--password abc`, `Bearer abc` or `//user:abc@host`.

    Parameters
    ----------
    text : str    the text

    Returns
    -------
    bool    True if the text contains a credential

    Examples
    --------
    >>> [contains_credential(text) for text in ("run --password hunter2", "run --max_token_length 512")]
    [True, False]
    """
    small = text.lower()
    if not any(hint in small for hint in _HINTS):
        return False
    named = any(_is_given(*found.groups()) for rule in (_ASSIGNED, _OPTION) for found in rule.finditer(text))
    return named or _IN_URL.search(text) is not None or _BEARER.search(text) is not None


def is_secret_list(values: Sequence[Any]) -> bool:
    """Check whether a list contains the name of a credential, as first entry or as an option, followed by its value.

    Parameters
    ----------
    values : sequence    decoded list

    Returns
    -------
    bool    True for lists such as `["set_token", "abc"]` and `["run", "--password", "abc"]`
    """
    for index, (name, value) in enumerate(pairwise(values)):
        if not isinstance(name, str) or not (index == 0 or name.startswith("-")) or _NAME.fullmatch(name) is None:
            continue
        if is_secret_name(name) and has_text(list(values[1:]) if index == 0 else value):
            return True
    return False


def _words_of(name: str) -> list[str]:
    return [word.lower() for word in _WORD.findall(name)]


def _is_secret(words: Sequence[str]) -> bool:
    return not _WORDS.isdisjoint(words) or not _PAIRS.isdisjoint(pairwise(words)) or tuple(words) == _WHOLE


def _is_given(name: str, value: str) -> bool:
    """Return whether a value is a credential, judged by the name to which it is assigned.

    A whole number counts only if the name ends with a word for a credential: `PASSWORD=12`, but not `TOKEN_COUNT=12`.
    """
    words = _words_of(name)
    if value.isdigit() and words and words[-1] not in _WORDS and tuple(words[-2:]) not in _PAIRS:
        return False
    return _is_secret(words)

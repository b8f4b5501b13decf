"""Signatures of failures: texts that are equal for failures with the same cause.

After two attempts with the same signature, a job is not retried.
"""

from __future__ import annotations

import hashlib
import signal
import traceback

NAME_CHARACTERS = 200
"""Greatest number of characters of the name of an exception class; the digest concerns the whole name."""

STAGING = "staging"
"""Signature of failures in which the server did not store the results."""


def of_exception(error: BaseException) -> str:
    """Return the signature of an exception: its type, and a digest of its type and traceback, but not of its text."""
    frames = traceback.extract_tb(error.__traceback__)
    places = [f"{frame.filename.rpartition('/')[2]}:{frame.name}:{frame.lineno}" for frame in frames]
    digest = hashlib.sha256("\n".join([type(error).__qualname__, *places]).encode()).hexdigest()
    return f"exception:{type(error).__name__[:NAME_CHARACTERS]}:{digest[:16]}"


def of_exit(status: int) -> str:
    """Return the signature of a process that ended unexpectedly with `status`; negative: the number of a signal."""
    return f"exit:{_signal_name(-status) if status < 0 else status}"


def describe_exit(status: int) -> str:
    """Return a text about a process that ended unexpectedly with `status`; negative: the number of a signal."""
    if status == -signal.SIGKILL:
        return "the process that ran the job was killed (SIGKILL); most likely the machine ran out of memory"
    if status < 0:
        return f"the process that ran the job was ended by {_signal_name(-status)}"
    return f"the process that ran the job exited with status {status}"


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"

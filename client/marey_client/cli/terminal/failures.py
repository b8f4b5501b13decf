"""Failures of commands: one line with the request id, and a traceback with `-v`."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from marey_schemas.wording import plain_reason, printable

FAILED, WRONG_USAGE = 1, 2
INTERRUPTED = 130
"""Exit status after Ctrl-C."""
MOST_SHOWN = 80
"""Greatest number of characters shown of a text that is not valid."""

ANONYMOUS_HINT = (
    "no token was found: run `marey login`, or give --token-file. A server on this machine stores a token in the file "
    "admin.token of its data folder; the variable MAREY_DATA can name this folder."
)


class Refused(Exception):
    """The server or a job refused a request or an input; the message is already printed, and the exit status is 1."""


class WrongUsage(Exception):
    """The arguments of the command are not valid; the text gives the reason."""


@contextmanager
def reported(*, verbose: bool) -> Iterator[None]:
    """Print expected errors as one line and exit with their status; other errors keep their traceback."""
    try:
        yield
    except Refused:
        sys.exit(FAILED)
    except WrongUsage as error:
        _exit(WRONG_USAGE, str(error), verbose)
    except Exception as error:
        from pydantic import ValidationError

        from marey_client.errors import BadAddress, BadArgument, MareyError
        from marey_schemas.encoding.codecs import CodecError

        if isinstance(error, ValidationError):
            first = error.errors(include_url=False)[0]
            where = ".".join(str(step) for step in first["loc"])
            text = plain_reason(first["msg"])
            _exit(WRONG_USAGE, f"{where}: {text}" if where else text, verbose)
        if isinstance(error, BadAddress | BadArgument | CodecError):
            _exit(WRONG_USAGE, str(error), verbose)
        if isinstance(error, UnicodeEncodeError):
            _exit(WRONG_USAGE, f"{error.object[:MOST_SHOWN]!r} is not text in UTF-8", verbose)
        if isinstance(error, MareyError | OSError):
            _exit(FAILED, sentence(error), verbose)
        raise


@contextmanager
def interrupted_by_sigterm() -> Iterator[None]:
    """Treat SIGTERM like Ctrl-C while the `with` block runs, so that the command removes what it has created."""
    import signal

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    earlier = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, earlier)


def sentence(error: BaseException) -> str:
    """Return an error in one line, with its code, request id, server and notes if it has them."""
    from marey_client.errors import NotFound, RequestFailed

    text = " ".join(_text_of(error).split()) or type(error).__name__
    if not isinstance(error, RequestFailed):
        return text
    where = f" at {error.server}" if error.server else ""
    whole = f"{text} ({error.code}, request {error.request_id}{where})"
    if error.anonymous and (isinstance(error, NotFound) or error.code == "unauthenticated"):
        return f"{whole}; {ANONYMOUS_HINT}"
    return "; ".join([whole, *getattr(error, "__notes__", ())])


def _text_of(error: BaseException) -> str:
    """Return the text of an error; for errors about files, the name of the file and the reason."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror is not None:
        return f"{os.fsdecode(error.filename)}: {error.strerror}"
    return str(error)


def _exit(status: int, text: str, verbose: bool) -> None:
    if verbose:
        import traceback

        traceback.print_exc()
    print(f"marey: {printable(text)}", file=sys.stderr)  # noqa: T201 - the error line itself
    sys.exit(status)

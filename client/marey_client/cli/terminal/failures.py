"""Failures of commands: one line with the request id, and a traceback with `-v`."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from marey_schemas.address import ADMIN_TOKEN_FILE
from marey_schemas.validation.reasons import first_reason, plain_reason
from marey_schemas.wording import printable

FAILED, WRONG_USAGE = 1, 2
INTERRUPTED = 130
"""Exit status after Ctrl-C."""
MOST_SHOWN = 80
"""Greatest number of characters shown of a text that is not valid."""

ANONYMOUS_HINT = (
    "no token was found: run `marey login`, or give --token-file. A server on this machine stores a token in the file "
    f"{ADMIN_TOKEN_FILE} of its data folder; the variable MAREY_DATA can name this folder."
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
            _exit(WRONG_USAGE, first_reason(error), verbose)
        if isinstance(error, BadAddress | BadArgument | CodecError):
            _exit(WRONG_USAGE, str(error), verbose)
        if isinstance(error, UnicodeEncodeError):
            _exit(WRONG_USAGE, f"{error.object[:MOST_SHOWN]!r} is not text in UTF-8", verbose)
        if isinstance(error, MareyError | OSError):
            _exit(FAILED, sentence(error), verbose)
        raise


@contextmanager
def usage_in_plain_words() -> Iterator[None]:
    """Replace the messages of pydantic and typer about wrong options and arguments by plain words."""
    from typer import BadParameter
    from typer._click.exceptions import NoSuchOption  # typer exports no class for it

    try:
        yield
    except BadParameter as error:
        faults = getattr(error.__cause__, "errors", None)
        if faults is not None:
            error.message = plain_reason(faults()[0])
        raise
    except NoSuchOption as error:
        files = [one for one in sys.argv[1:] if one.startswith(error.option_name) and os.path.exists(one)]
        if files:
            error.message = f"{files[0]} is read as an option; for the file of this name, write ./{files[0]}"
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
    """Return an error and its notes as one line of text.

    For an error that the server sent, the line also contains the code, the request id and the address of the server.
    """
    from marey_client.errors import NotFound, RequestFailed

    text, notes = " ".join(_text_of(error).split()) or type(error).__name__, getattr(error, "__notes__", ())
    if not isinstance(error, RequestFailed):
        return "; ".join([text, *notes])
    where = f" at {error.server}" if error.server else ""
    whole = f"{text} ({error.code}, request {error.request_id}{where})" if error.request_id else text
    if error.anonymous and (isinstance(error, NotFound) or error.code == "unauthenticated"):
        return f"{whole}; {ANONYMOUS_HINT}"
    return "; ".join([whole, *notes])


def _text_of(error: BaseException) -> str:
    """Return the text of an error; for errors of the system, the file and the reason without its number."""
    if not isinstance(error, OSError) or error.strerror is None:
        return str(error)
    if error.filename is None:
        return error.strerror
    file = Path(os.fsdecode(error.filename))
    if isinstance(error, FileNotFoundError) and not file.parent.exists():
        return f"{file}: there is no folder {file.parent}; create it, or name another file"
    if isinstance(error, FileExistsError | NotADirectoryError) and file.is_file():
        return f"{file} exists already, as a file; choose another name"
    return f"{file}: {error.strerror}"


def _exit(status: int, text: str, verbose: bool) -> None:
    if verbose:
        import traceback

        traceback.print_exc()
    print(f"marey: {printable(text)}", file=sys.stderr)  # noqa: T201 - the error line itself
    sys.exit(status)

"""Start of other programs by the server: workers, the processes that share a port, and the compilation of kernels."""

from __future__ import annotations

import asyncio
import sys
from asyncio.subprocess import Process
from collections.abc import Mapping, Sequence


async def start_program(
    *arguments: str, environment: Mapping[str, str], stdin: int | None = None, inherited: Sequence[int] = ()
) -> Process:
    """Start a Python interpreter with arguments as a new process, and return the process.

    The process inherits the descriptors `inherited`. `stdin` is a descriptor, `asyncio.subprocess.PIPE`, or None to
    inherit the standard input. Raises `OSError` if the process cannot be started.

    The process gets a session of its own: Ctrl-C in the terminal of the server reaches only the server, which
    then stops the process. Otherwise, a process that is still loading modules would print a traceback.
    """
    return await asyncio.create_subprocess_exec(
        sys.executable, *arguments, stdin=stdin, pass_fds=inherited, env=environment, start_new_session=True
    )

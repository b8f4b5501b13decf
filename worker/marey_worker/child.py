"""Child process of a worker, which computes jobs.

It runs one job after another, so that modules and compiled kernels are loaded only once.
"""

from __future__ import annotations

import gc
import importlib
import os
import sys
import traceback
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import to_jsonable_python

from marey_schemas.processes.child_process import READY, connect_to_parent
from marey_schemas.processes.limits import allow_memory
from marey_schemas.processes.memory import loading_modules
from marey_schemas.queue.job_kinds import find_kind
from marey_schemas.queue.kind_declaration import KindDeclaration
from marey_schemas.queue.worker_protocol import LONGEST_CODE, LONGEST_DETAIL
from marey_schemas.validation.reasons import first_reason
from marey_worker import signatures
from marey_worker.context import Context, JobRefused, Unreadable
from marey_worker.messages import BAD_RESULT, UNPACKABLE, Done, End, Failed, Run, pack, unpack
from marey_worker.texts import storable

DETAIL_CHARACTERS = 1000


def main() -> None:
    """Run the jobs that arrive on a pipe until the pipe closes.

    The first argument is the file descriptor of the pipe; the other arguments are kinds of jobs whose modules are
    loaded first.
    """
    pipe = connect_to_parent()
    process = os.getpid()
    with loading_modules():
        load(sys.argv[2:])
    try:
        pipe.send_bytes(READY)
    except BrokenPipeError:  # the supervisor was stopped while this loaded
        return
    garbage = Garbage()
    while True:
        try:
            run = unpack(pipe.recv_bytes())
        except EOFError:
            return
        if not isinstance(run, Run):  # an answer to a job that did not wait for it
            continue
        write_output_to(run.log_path)
        end = run_job(run, pipe)
        if os.getpid() != process:  # forked by the job, and not to answer for it
            os._exit(1)
        sys.stdout.flush()
        sys.stderr.flush()
        pipe.send_bytes(_packed(end))
        garbage.collect()


class Garbage:
    """Garbage collector that is called after each job, and skips the objects of loaded modules.

    Modules own nearly all objects and live as long as the process; searching these objects would take 0.1 s after every
    job.
    """

    def __init__(self) -> None:
        self._modules = 0
        self.collect()

    def collect(self) -> None:
        """Free cyclic garbage.

        If modules were loaded since the last call, exclude all existing objects from later searches.
        """
        gc.collect()
        if len(sys.modules) != self._modules:
            self._modules = len(sys.modules)
            gc.freeze()


def load(kinds: list[str]) -> None:
    """Import the modules that the kinds of jobs need, so that the first job does not wait for the import."""
    for name in kinds:
        module = find_kind(name).implementation.partition(":")[0]
        try:
            importlib.import_module(module)
        except ImportError as error:  # jobs of this kind will fail and say so; those of others need not
            sys.stderr.write(f"jobs of kind {name} cannot run here: {error}\n")


def run_job(run: Run, pipe: Connection) -> End:
    """Run one job; return the message `Done` with its result, or `Failed` with the reason."""
    context = Context(run, pipe)
    allow_memory(run.memory_limit_bytes)
    try:
        result = to_jsonable_python(_perform(find_kind(run.kind), context, run))
    except JobRefused as error:
        return _failed(error.code, error.detail)
    except Unreadable as error:  # inputs are pinned: what is not there now will not be there at the next try
        return _failed(error.code, str(error))
    except ValidationError as error:
        return _failed("invalid-params", first_reason(error))
    except MemoryError:
        detail = f"the job needs more memory than its limit of {run.memory_limit_bytes >> 20} MiB"
        return _failed("memory-limit", detail, "memory-limit", retryable=True)
    except Exception as error:  # noqa: BLE001 - whatever a kind raises ends this job, not the process
        sys.stderr.write("".join(traceback.format_exception(error)))
        what = "".join(traceback.format_exception_only(error)).strip()[:DETAIL_CHARACTERS]
        code = getattr(error, "code", "exception")
        code = code if isinstance(code, str) else "exception"
        return _failed(code, f"{what}; the job's log shows where", signatures.of_exception(error), retryable=True)
    finally:
        allow_memory(None)
    return Done(result, context.shareable)


def _packed(end: End) -> bytes:
    """Encode the message about the end of a job; if its result cannot be sent, encode a failure instead."""
    try:
        return pack(end)
    except UNPACKABLE as error:
        return pack(_failed(BAD_RESULT, f"the result cannot be sent: {error}"))


def _failed(code: str, detail: str, signature: str | None = None, *, retryable: bool = False) -> Failed:
    """Return the message that a job has failed, with texts that can be sent and stored."""
    return Failed(storable(code, LONGEST_CODE), storable(detail, LONGEST_DETAIL), signature, retryable)


def write_output_to(path: Path) -> None:
    """Redirect the output of this process, including that of native code and of a crash, to a file."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    os.close(descriptor)


def _perform(kind: KindDeclaration, context: Context, run: Run) -> dict[str, Any]:
    """Run a job with the functions of its kind, and return the result.

    A task runs the implementation. A parent job runs the gathering function, which combines the results of its tasks. A
    job that is not divided runs the implementation and then, if the kind has one, the gathering function.
    """
    params = kind.params.model_validate(run.params)
    is_task, gathers = run.position is not None, run.position is None and run.size is not None
    results = context.task_results() if gathers else [_function(kind.implementation)(context, params)]
    if kind.gathering is None or is_task:
        return results[0]
    gathered: dict[str, Any] = _function(kind.gathering)(context, params, results)
    return gathered


def _function(name: str) -> Any:
    module, _, function = name.partition(":")
    return getattr(importlib.import_module(module), function)


if __name__ == "__main__":
    main()

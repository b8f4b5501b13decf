"""Kinds of job from another distribution, as a worker sees them: one that works, one that fails in every way."""

import ctypes
import os
import resource
import sys
import time
from typing import Any

from marey_schemas.base import Request
from marey_schemas.job_kinds import KindDeclaration
from marey_schemas.kinds import Kind
from marey_schemas.worker_protocol import PinnedInput
from marey_worker.context import JobRefused


class AddParams(Request):
    a: int
    b: int


class MisbehaveParams(Request):
    how: str
    seconds: float = 0.0


def add(context: Any, params: Any) -> Any:
    context.log(f"adding {params.a} and {params.b}")
    context.progress(1, 2, "half way")
    return {"sum": params.a + params.b, "pid": os.getpid()}


def misbehave(context: Any, params: Any) -> Any:
    return {
        "raise": _raise, "refuse": _refuse, "segfault": _segfault, "exit": _exit, "eat": _eat, "hoard": _hoard,
        "fork-and-raise": _fork_and_raise,
        "sleep": lambda: _sleep(params.seconds), "shout": _shout, "ignore-term": lambda: _ignore_term(params.seconds),
        "give-up-early": lambda: _give_up_early(context), "put": lambda: _put(context),
        "miss": lambda: context.document(Kind.SKELETON, "skeleton_gone", 1, "hierarchy"),
    }[params.how]()  # fmt: skip


def _raise() -> None:
    raise ArithmeticError("the numbers do not add up")


def _refuse() -> None:
    raise JobRefused("not-today", "this cannot be done")


def _segfault() -> None:
    ctypes.string_at(0)


def _exit() -> None:
    os._exit(7)


def _eat() -> Any:
    return {"bytes": len(bytearray(8 << 30))}


def _hoard() -> None:
    """Memory in small helpings, which no single allocation gives away; in a process of its own that lifts its limit."""
    if os.fork() == 0:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        hoard = []
        while True:
            hoard.append(b"x" * (4 << 20))
            time.sleep(0.001)
    time.sleep(60)


def _fork_and_raise() -> Any:
    """The copy of this process gets as far as its end, and must not be taken for the job."""
    if os.fork() == 0:
        raise ArithmeticError("raised in a copy")
    time.sleep(1)
    return {"survived": True}


def _sleep(seconds: Any) -> Any:
    time.sleep(seconds)
    return {"slept": True}


def _ignore_term(seconds: Any) -> Any:
    import signal

    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return _sleep(seconds)


def _shout() -> Any:
    print("said on standard output")
    print("said on standard error", file=sys.stderr)
    return {}


def _give_up_early(context: Any) -> None:
    """Fail while answers are still on their way."""
    pin = PinnedInput(item="clip_1", revision=1, kind="clip", name="walk", collection="")
    reading = context.documents([pin] * 20, "motion")
    next(reading)
    raise ArithmeticError("enough")


def _put(context: Any) -> Any:
    path = context.scratch / "result.bin"
    path.write_bytes(b"bytes that a job made")
    return {"digest": context.put_file(path)}


class TallyParams(Request):
    tasks: int


def tally(context: Any, params: Any) -> Any:
    return {"task": list(context.task), "threads": context.threads}


def gather_tally(context: Any, params: Any, results: Any) -> Any:
    return {"seen": [result["task"] for result in results]}


TALLY = KindDeclaration(
    "tally", "Counts its tasks.", TallyParams, "marey_test_kinds:tally", 1, {},
    task_count=lambda params: params.tasks, gathering="marey_test_kinds:gather_tally",
)  # fmt: skip
ADD = KindDeclaration("add", "Adds.", AddParams, "marey_test_kinds:add", 1, {})
MISBEHAVE = KindDeclaration("misbehave", "Fails.", MisbehaveParams, "marey_test_kinds:misbehave", 1, {})

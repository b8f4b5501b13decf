"""Job kinds of another Python package, as a worker finds them: kinds that work, and one that fails in many ways."""

import ctypes
import math
import os
import random
import resource
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from marey_schemas.base import Request
from marey_schemas.kinds import Kind
from marey_schemas.queue.kind_declaration import KindDeclaration
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput
from marey_worker.context import Context, JobRefused, Unreadable


class AddParams(Request):
    a: int
    b: int


class MisbehaveParams(Request):
    how: str
    seconds: float = 0.0
    folder: str = ""
    blob: str = ""


ODD = {"nan": math.nan, "inf": math.inf, str(1 << 63): 1 << 63, str(1 << 64): 1 << 64, "half a character": "\udc80"}
"""Values that are no valid results."""


def add(context: Context, params: AddParams) -> dict[str, int]:
    context.log(f"adding {params.a} and {params.b}")
    context.progress(1, 2, "half way")
    return {"sum": params.a + params.b, "pid": os.getpid()}


def misbehave(context: Context, params: MisbehaveParams) -> dict[str, Any]:
    ways: dict[str, Callable[[], Any]] = {
        "raise": _raise, "refuse": _refuse, "segfault": _segfault, "exit": _exit, "eat": _eat,
        "hoard": lambda: _hoard(Path(params.folder)), "wait": lambda: _wait(Path(params.folder)),
        "fork-and-raise": _fork_and_raise,
        "raise-oddly": _raise_oddly, "refuse-oddly": _refuse_oddly, "report-oddly": lambda: _report_oddly(context),
        "sleep": lambda: _sleep(params.seconds),
        "give-up-early": lambda: _give_up_early(context), "put": lambda: _put(context),
        "read-blob": lambda: {"bytes": len(context.blob(params.blob))},
        "read-late": lambda: _read_late(context, Path(params.folder)),
        "miss": lambda: context.document(Kind.SKELETON, "skeleton_gone", 1, "hierarchy"),
        "answer-oddly": lambda: {"odd": ODD[params.blob]},
        "do-without": lambda: _do_without(context, params.blob),
        "have-no-mapping": lambda: {
            "mapping": context.document(Kind.SKELETON, "skeleton_gone", 1, "mapping", required=False)
        },
    }  # fmt: skip
    return ways[params.how]()


def _raise() -> None:
    raise ArithmeticError("the numbers do not add up")


def _raise_oddly() -> None:
    """Raise an error with an extremely long class name, and characters in its text that a database does not store."""
    raise type("Odd" * 200, (Exception,), {})("a\0b\udc80c")


def _refuse_oddly() -> None:
    raise JobRefused("odd" * 100, "a\0b\udc80c" * 10_000)


def _report_oddly(context: Context) -> dict[str, bool]:
    context.progress(1, 2, "a\0b\udc80c" * 1000)
    time.sleep(2)
    return {"reported": True}


def _refuse() -> None:
    raise JobRefused("not-today", "this cannot be done")


def _segfault() -> None:
    ctypes.string_at(0)


def _exit() -> None:
    os._exit(7)


def _eat() -> dict[str, int]:
    return {"bytes": len(bytearray(8 << 30))}


def _hoard(folder: Path) -> None:
    """Fork a process that writes its id to a file, removes its memory limit, and allocates more and more memory."""
    if os.fork() == 0:
        (folder / "hoarder").write_text(str(os.getpid()))
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        hoard = []
        while True:
            hoard.append(b"x" * (4 << 20))
            time.sleep(0.001)
    time.sleep(60)


def _wait(folder: Path) -> dict[str, bool]:
    """Create the file `started`, and wait until the file `go` exists."""
    (folder / "started").touch()
    while not (folder / "go").exists():
        time.sleep(0.01)
    return {"waited": True}


def _fork_and_raise() -> dict[str, bool]:
    """Raise an error in a forked copy of this process; the job must not fail because of it."""
    if os.fork() == 0:
        raise ArithmeticError("raised in a copy")
    time.sleep(1)
    return {"survived": True}


def _sleep(seconds: float) -> dict[str, bool]:
    time.sleep(seconds)
    return {"slept": True}


def _give_up_early(context: Context) -> None:
    """Raise an error while documents that were requested are still arriving."""
    pin = PinnedInput(item="clip_1", revision=1, kind="clip", name="walk", collection="")
    reading = context.documents([pin] * 20, "motion")
    next(reading)
    raise ArithmeticError("enough")


def _do_without(context: Context, blob: str) -> dict[str, str]:
    """Read a file, or a skeleton if `blob` is empty; continue without it if it cannot be read."""
    try:
        if blob:
            context.blob(blob)
        else:
            context.document(Kind.SKELETON, "skeleton_gone", 1, "hierarchy")
    except Unreadable as error:
        return {"lacks": error.code}
    return {"lacks": ""}


def _put(context: Context) -> dict[str, str]:
    path = context.scratch / "result.bin"
    path.write_bytes(b"bytes that a job made")
    return {"digest": context.put_file(path)}


def _read_late(context: Context, folder: Path) -> dict[str, bool]:
    """Request more documents than the pipe can hold, and do not read the second one until the file `go` exists."""
    pin = PinnedInput(item="clip_1", revision=1, kind="clip", name="walk", collection="")
    reading = context.documents([pin] * 20, "motion")
    next(reading)
    return _wait(folder)


class MakeParams(Request):
    results: int


def make(context: Context, params: MakeParams) -> dict[str, int]:
    for number in range(params.results):
        context.log(f"making {number}")
        context.stage([StagedOutput(name=f"made-{number}", kind=Kind.CLIP, item_name="made", parts={"info": {}})])
    return {"made": params.results}


class DrawParams(Request):
    name: str
    seed: int
    seconds: float = 0.0


def draw(context: Context, params: DrawParams) -> dict[str, int]:
    """Make a skeleton whose bone lengths are drawn, after a pause."""
    time.sleep(params.seconds)
    chance = random.Random(params.seed)
    joints = [{"name": f"j{n}", "parent": n - 1, "offset": [0.0, round(chance.random(), 6), 0.0]} for n in range(5)]
    parts = {"hierarchy": {"schema": "marey/skeleton@1", "joints": joints}}
    context.stage([StagedOutput(name="drawn", kind=Kind.SKELETON, item_name=params.name, parts=parts)])
    return {"seed": params.seed}


class TallyParams(Request):
    tasks: int


def tally(context: Context, params: TallyParams) -> dict[str, Any]:
    return {"task": list(context.task), "threads": context.threads}


def gather_tally(context: Context, params: TallyParams, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {"seen": [result["task"] for result in results]}


TALLY = KindDeclaration(
    "tally", "Counts its tasks.", TallyParams, "marey_test_kinds:tally", 1, {},
    task_count=lambda params: params.tasks, gathering="marey_test_kinds:gather_tally",
)  # fmt: skip
ADD = KindDeclaration("add", "Adds.", AddParams, "marey_test_kinds:add", 1, {})
MISBEHAVE = KindDeclaration("misbehave", "Fails.", MisbehaveParams, "marey_test_kinds:misbehave", 1, {})
MAKE = KindDeclaration("make", "Makes clips.", MakeParams, "marey_test_kinds:make", 1, {"clips": Kind.CLIP})
DRAW = KindDeclaration(
    "draw", "Draws a skeleton.", DrawParams, "marey_test_kinds:draw", 1, {"skeletons": Kind.SKELETON}
)

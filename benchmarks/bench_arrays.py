"""Time to send a clip as JSON, and a range of its frames as bytes, over HTTP, compared with Tiled.

Both servers send the same array. Times are processor time of the server per answer. Tiled runs in a Python environment
of its own, because Tiled needs SQLAlchemy below 2.1 and pydantic-settings below 2.12, but Marey needs newer versions.
The variable `MAREY_BENCH_TILED` names the interpreter of this environment; CONTRIBUTING.md describes how to create it.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import psutil

from benchmarks.local_server import PROJECT, free_port, local_server, seed
from benchmarks.material import noisy_clip
from benchmarks.timing import Row
from marey_schemas.encoding.codecs import JSON, MSGPACK

FRAMES, JOINTS = 3000, 63
CUT = "500:1000"
ROUNDS, ANSWERS = 5, 10
GOAL_JSON_MS = 30
START_S = 60
TILED = "MAREY_BENCH_TILED"

Ask = Callable[[], object]


def run() -> list[Row]:
    """Measure a server that stores no answers in memory, so that it computes each answer."""
    with local_server(MAREY_ANSWER_CACHE_BYTES="0") as server, _tiled() as tiled, httpx.Client() as http:
        clip = seed(server, FRAMES, JOINTS).clip

        def part(form: str, frames: str | None = None) -> float:
            address = f"{server.url}/api/v1/projects/{PROJECT}/clips/{clip}/parts/motion"
            headers = {"Accept": form, "Authorization": f"Bearer {server.token}"}
            query = {} if frames is None else {"frames": frames}
            return _milliseconds(
                server.pid, lambda: http.get(address, params=query, headers=headers).raise_for_status()
            )

        def peer(form: str, frames: str = "") -> float | None:
            if tiled is None:
                return None
            address = f"http://127.0.0.1:{tiled[1]}/api/v1/array/full/poses"
            query = {"format": form, "slice": frames}
            return _milliseconds(tiled[0], lambda: http.get(address, params=query).raise_for_status())

        rounds = [
            (
                (part(JSON), peer(JSON)),
                (part(MSGPACK, CUT), peer("application/octet-stream", CUT)),
                (part(f"{MSGPACK}; arrays=blocks", CUT), None),
            )
            for _ in range(ROUNDS + 1)
        ][1:]
    whole, raw, blocks = zip(*rounds, strict=True)
    shape = f"{FRAMES} x {3 + 4 * JOINTS} float32"
    raw_ms = min(ours for ours, _ in raw)
    return [
        _row("a whole clip as JSON", shape, whole, f"≤ {GOAL_JSON_MS} ms", GOAL_JSON_MS),
        _row("frames of a clip, raw", f"{CUT} of {shape}", raw, "", None),
        replace(
            _row("frames of a clip, as blocks", f"{CUT} of {shape}", blocks, "≤ raw", 1.1 * raw_ms),
            peer=f"the same frames, raw: {raw_ms:.1f} ms",
        ),
    ]


def _milliseconds(pid: int, ask: Ask) -> float:
    """Return the processor time in milliseconds that the server process `pid` needs for one call of `ask`."""
    server = psutil.Process(pid)
    before = server.cpu_times()
    for _ in range(ANSWERS):
        ask()
    after = server.cpu_times()
    return 1e3 * (after.user + after.system - before.user - before.system) / ANSWERS


def _row(job: str, size: str, rounds: tuple[tuple[float, float | None], ...], goal: str, limit: float | None) -> Row:
    ours = min(milliseconds for milliseconds, _ in rounds)
    theirs = min((milliseconds for _, milliseconds in rounds if milliseconds is not None), default=None)
    peer = f"Tiled did not run: {TILED} names no interpreter" if theirs is None else f"Tiled {theirs:.1f} ms"
    return Row(
        job,
        size,
        f"{ours:.1f} ms",
        peer,
        None if theirs is None else theirs / ours,
        goal,
        None if limit is None else ours <= limit,
    )


@contextmanager
def _tiled() -> Iterator[tuple[int, int] | None]:
    """Run Tiled with the array of the clip while the `with` block runs; yield the process id and port of Tiled.

    Yields None if no interpreter for Tiled is named.
    """
    interpreter = os.environ.get(TILED)
    if interpreter is None:
        yield None
        return
    with tempfile.TemporaryDirectory(prefix="marey-bench-") as folder:
        array, port = Path(folder, "poses.npy"), free_port()
        np.save(array, noisy_clip(FRAMES, JOINTS).poses)
        script = Path(__file__).with_name("tiled_server.py")
        process = subprocess.Popen([interpreter, str(script), str(port), str(array)], stdout=subprocess.DEVNULL)
        try:
            _wait_for(port, process)
            yield process.pid, port
        finally:
            process.terminate()
            process.wait()


def _wait_for(port: int, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and process.poll() is None:
        try:
            if httpx.get(f"http://127.0.0.1:{port}/api/v1/").is_success:
                return
        except httpx.TransportError:
            time.sleep(0.1)
    raise RuntimeError(f"Tiled did not start with the interpreter that {TILED} names")

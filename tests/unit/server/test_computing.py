"""Threads that compute: long computations leave some to others, and none keeps a server from ending."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from marey_server.errors import UnavailableProblem
from marey_server.process import computing
from marey_server.process.computing import ComputeThreads


def test_long_computations_leave_a_thread_to_others() -> None:
    async def main() -> None:
        threads, end = ComputeThreads(2), threading.Event()

        async def compute_long() -> bool:
            async with threads.long_place():
                return await asyncio.wrap_future(threads.submit(end.wait, 30))

        long = [asyncio.create_task(compute_long()) for _ in range(3)]
        await asyncio.sleep(0.05)
        assert await asyncio.wait_for(asyncio.wrap_future(threads.submit(lambda: "quick")), 10) == "quick"
        end.set()
        assert await asyncio.gather(*long) == [True] * 3

    asyncio.run(main())


def test_who_waits_too_long_is_told_to_ask_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(computing, "LONGEST_WAIT_FOR_PLACE_S", 0.01)

    async def main() -> None:
        threads = ComputeThreads(2)
        async with threads.long_place():
            with pytest.raises(UnavailableProblem) as refused:
                async with threads.long_place():
                    pass
        assert int(refused.value.headers["Retry-After"]) > 0
        async with threads.long_place():
            pass

    asyncio.run(main())


ENDLESS = """
import sys, time
from marey_server import app, commands
create = app.create_app
def create_computing(settings, database):
    made = create(settings, database)
    for _ in range(9):
        made.services.compute_threads.submit(time.sleep, 600)
    return made
app.create_app = create_computing
commands.serve(data=sys.argv[1], port=0, drain_s=1, local_workers=0, log_form="text")
"""


def test_a_server_that_is_told_to_stop_does_not_wait_for_computations(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ENDLESS, str(tmp_path)], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert any("listening" in line for line in process.stderr)
        process.send_signal(signal.SIGTERM)
        try:
            assert process.wait(120) == 0
        finally:
            process.kill()

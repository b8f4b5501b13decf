"""Calls of the async client in threads: order, cancellation, waits, functions of the user."""

import asyncio
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import httpcore
import httpx
import pytest
from tests.support.scripted_server import ScriptedServer

from marey_client.asynchronous.calls import GRACE_S, Calls
from marey_client.asynchronous.interruption import CallPool, Interrupted, pause, stop_if_interrupted, waiting
from marey_client.asynchronous.marey import AsyncMarey
from marey_client.errors import ConnectionClosed
from marey_client.progress import ignore_progress, progress

LONG_S = 60.0
SOON_S = 10.0
ME = {"user": None, "scopes": [], "token": None}


def run(program: Callable[[Calls], Coroutine[Any, Any, None]], concurrency: int = 1) -> None:
    async def main() -> None:
        calls = Calls(concurrency)
        try:
            await program(calls)
        finally:
            await calls.close(lambda: None)

    asyncio.run(main())


async def cancelled(task: asyncio.Task[Any]) -> float:
    """Cancel a task that has begun; return the seconds that it took to end."""
    started = time.monotonic()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    return time.monotonic() - started


def test_calls_begin_in_their_order_and_a_cancelled_one_never() -> None:
    ran: list[int] = []
    begin = threading.Event()

    async def program(calls: Calls) -> None:
        first = asyncio.create_task(calls.run(begin.wait, LONG_S))
        others = [asyncio.create_task(calls.run(ran.append, number)) for number in range(4)]
        await asyncio.sleep(0)
        assert await cancelled(others[1]) < GRACE_S / 2
        begin.set()
        await asyncio.gather(first, others[0], others[2], others[3])

    run(program)
    assert ran == [0, 2, 3]


def test_a_wait_leaves_its_place_to_another_call_and_ends_when_it_is_cancelled() -> None:
    async def program(calls: Calls) -> None:
        pausing = [asyncio.create_task(calls.run(pause, LONG_S)) for _ in range(5)]
        await asyncio.sleep(0.1)
        assert await calls.run(int, "7") == 7
        for one in pausing:
            assert await cancelled(one) < SOON_S
        assert calls._running == 0

    run(program)


def test_threads_of_a_cancelled_call_stop_too() -> None:
    ended: list[str] = []

    def piece(_number: int) -> None:
        try:
            pause(LONG_S)
        except Interrupted:
            ended.append("interrupted")
            raise

    def work() -> None:
        with CallPool(2) as pool:
            list(pool.map(piece, range(4)))

    async def program(calls: Calls) -> None:
        working = asyncio.create_task(calls.run(work))
        await asyncio.sleep(0.2)
        assert await cancelled(working) < SOON_S

    run(program)
    assert ended == ["interrupted"] * 2  # the others never began


def test_a_thread_that_computes_is_left_after_a_moment_and_can_send_nothing() -> None:
    go_on = threading.Event()
    later: list[str] = []

    def compute() -> None:
        go_on.wait(LONG_S)
        try:
            stop_if_interrupted()  # before each request
        except Interrupted:
            later.append("interrupted")
            raise

    async def program(calls: Calls) -> None:
        computing = asyncio.create_task(calls.run(compute))
        await asyncio.sleep(0.1)
        assert GRACE_S * 0.9 < await cancelled(computing) < GRACE_S + SOON_S
        go_on.set()

    run(program)
    assert later == ["interrupted"]


def test_a_closed_client_refuses_calls() -> None:
    async def main() -> None:
        calls = Calls(1)
        running, queued = (asyncio.create_task(calls.run(pause_without_leaving)) for _ in range(2))
        await asyncio.sleep(0.1)
        await calls.close(lambda: None)
        for one in (running, queued):
            with pytest.raises(ConnectionClosed):
                await one
        with pytest.raises(ConnectionClosed, match="the client is closed"):
            await calls.run(int)

    def pause_without_leaving() -> None:
        while True:
            stop_if_interrupted()
            time.sleep(0.01)

    asyncio.run(main())


def test_only_one_progress_bar_is_shown_at_a_time() -> None:
    with progress(shown=True) as first:
        with progress(shown=True) as second:
            assert second is ignore_progress
        assert first is not ignore_progress
    with progress(shown=True) as third:
        assert third is not ignore_progress


def test_nested_waits_of_a_call_free_one_place() -> None:
    async def program(calls: Calls) -> None:
        def work() -> int:
            with waiting(), waiting():
                return calls._running

        assert await calls.run(work) == 0
        assert calls._running == 0

    run(program)


def test_entries_of_one_answer_are_read_in_one_call_and_an_iterator_may_be_left(script: ScriptedServer) -> None:
    threads: list[str] = []

    def numbers() -> Iterator[int]:
        for number in range(3):
            threads.append(threading.current_thread().name)
            yield number

    async def program(calls: Calls) -> None:
        assert [one async for one in calls.each(numbers)] == [0, 1, 2]
        async for one in calls.each(numbers):
            assert one == 0
            break

    run(program)
    assert all(name.startswith("marey-async") for name in threads)


def test_a_function_of_the_user_runs_in_the_loop_and_may_use_the_client(script: ScriptedServer) -> None:
    """Also if only one call runs at a time, and the call of the function is that one."""

    async def main() -> None:
        async with AsyncMarey("http://server.test", "t", http=script.transport(), concurrency=1) as server:

            async def ask(number: int) -> int:
                assert threading.current_thread() is threading.main_thread()
                return number + len((await server.me()).scopes)

            def fail(number: int) -> int:
                raise ValueError(f"number {number}")

            assert await server.call(lambda function: function(5), ask) == 5
            with pytest.raises(ValueError, match="number 6"):
                await server.call(lambda function: function(6), fail)

            async def never() -> None:
                await asyncio.sleep(LONG_S)

            task = asyncio.create_task(server.call(lambda function: function(), never))
            await asyncio.sleep(0.1)
            assert await cancelled(task) < SOON_S

    script.answers = [httpx.Response(200, json=ME)]
    asyncio.run(main())


def test_an_iterator_that_ends_raises_an_error_in_the_task() -> None:
    async def program(calls: Calls) -> None:
        with pytest.raises(RuntimeError, match="raised StopIteration"):
            async with asyncio.timeout(SOON_S):
                await calls.run(next, iter(()))

    run(program)


def test_many_waits_and_functions_of_the_user_leave_threads_for_other_calls(script: ScriptedServer) -> None:
    async def main() -> None:
        async with AsyncMarey("http://server.test", "t", http=script.transport()) as server:

            async def ask(number: int) -> int:
                await asyncio.sleep(0.1)
                return int(await server.call(str, number))

            many = range(300)
            async with asyncio.timeout(LONG_S):
                asked = [server.call(lambda function, number: function(number), ask, number) for number in many]
                assert await asyncio.gather(*asked) == list(many)
            waits = [asyncio.create_task(server.call(pause, LONG_S)) for _ in many]
            async with asyncio.timeout(SOON_S):
                assert await server.call(int, "7") == 7
            for one in waits:
                one.cancel()
            await asyncio.gather(*waits, return_exceptions=True)

    asyncio.run(main())


def test_no_function_of_the_user_begins_after_the_call_was_cancelled(script: ScriptedServer) -> None:
    go_on = threading.Event()
    ran: list[int] = []

    def work(function: Callable[[int], None]) -> None:
        go_on.wait(LONG_S)
        function(1)

    async def main() -> None:
        async with AsyncMarey("http://server.test", "t", http=script.transport()) as server:
            task = asyncio.create_task(server.call(work, ran.append))
            await asyncio.sleep(0.1)
            await cancelled(task)
            go_on.set()
            await asyncio.sleep(0.2)

    asyncio.run(main())
    assert ran == []


def test_tasks_that_a_function_of_the_user_starts_outlive_the_call(script: ScriptedServer) -> None:
    later: list[asyncio.Task[None]] = []

    async def main() -> None:
        async with AsyncMarey("http://server.test", "t", http=script.transport()) as server:

            async def start(*, pause_s: float) -> None:
                later.append(asyncio.create_task(asyncio.to_thread(pause, pause_s)))
                await asyncio.sleep(LONG_S)

            task = asyncio.create_task(server.call(lambda function: function(pause_s=0.3), start))
            while not later:
                await asyncio.sleep(0.01)
            await cancelled(task)
            await later[0]  # the synchronous SDK is not interrupted there

    asyncio.run(main())


def test_a_function_of_the_user_may_be_called_in_threads_that_the_user_starts(script: ScriptedServer) -> None:
    def work(function: Callable[[int], int]) -> list[int]:
        with ThreadPoolExecutor(2) as pool:
            return list(pool.map(function, range(3)))

    async def main() -> None:
        async with AsyncMarey("http://server.test", "t", http=script.transport()) as server:

            async def double(number: int) -> int:
                return 2 * number

            assert await server.call(work, double) == [0, 2, 4]

    asyncio.run(main())


def test_a_call_that_connects_ends_when_it_is_cancelled_and_its_connection_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    go_on, closed = threading.Event(), threading.Event()

    class Connected(httpcore.NetworkStream):
        def close(self) -> None:
            closed.set()

    def connect(*_args: Any) -> httpcore.NetworkStream:
        go_on.wait(LONG_S)
        return Connected()

    async def main() -> None:
        monkeypatch.setattr(httpcore.SyncBackend, "connect_tcp", connect)
        async with AsyncMarey("http://server.test", "t") as server:
            asking = asyncio.create_task(server.me())
            await asyncio.sleep(0.2)
            assert await cancelled(asking) < GRACE_S / 2

    started = time.monotonic()
    asyncio.run(main())
    assert time.monotonic() - started < SOON_S  # closing does not wait for the connection either
    go_on.set()
    assert closed.wait(SOON_S)


def test_a_forked_process_has_threads_and_connections_of_its_own() -> None:
    program = """
import asyncio, os, sys
from marey_client.asynchronous.marey import AsyncMarey

client = AsyncMarey(sys.argv[1], "t")
asyncio.run(client.me())
child = os.fork()
asyncio.run(client.me())
asyncio.run(client.close())
sys.exit(os.waitpid(child, 0)[1] if child else 0)
"""
    connections: set[Any] = set()

    class Answer(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            connections.add(self.client_address)
            body = json.dumps(ME).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - named by the base class
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Answer) as server:
        threading.Thread(target=server.serve_forever).start()
        address = f"http://127.0.0.1:{server.server_port}"
        try:
            subprocess.run([sys.executable, "-c", program, address], check=True, timeout=LONG_S)
        finally:
            server.shutdown()
    assert len(connections) == 2

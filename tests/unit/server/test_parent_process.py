"""The parent of several server processes, with a program that pretends to be one; and the limits of each process."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from marey_schemas.backoff import Backoff
from marey_server import commands
from marey_server.http.accepting import listen
from marey_server.process import notices, programs
from marey_server.process.settings import Settings
from marey_server.process.worker_pools import OwnPods
from marey_server.process_program import share_of
from marey_server.shared_port import handles, parent
from marey_server.shared_port.parent import Parent, ProcessesFailed

WAIT_S = 60.0


class Played:
    """A parent of two pretended processes, whose notices to systemd are received here."""

    def __init__(self, folder: Path, notified: socket.socket) -> None:
        self.folder = folder
        self._notified = notified
        self.behave("serve")

    def behave(self, how: str) -> None:
        """Set the behaviour of processes that start from now on."""
        (self.folder / "behaviour").write_text(how)

    async def play(self, script: Callable[[Parent], Awaitable[None]], **workers: Any) -> None:
        """Run the parent until a script has ended, or until the parent fails.

        `workers` are the settings of the workers that it starts, by default one on this machine.
        """
        chosen = workers or {"local_workers": 1}
        settings = Settings(data=self.folder / "data", processes=2, drain_s=1, **chosen)
        sockets = listen("127.0.0.1", 0)
        tested = Parent(settings, {"folder": str(self.folder)}, sockets, ())

        async def act() -> None:
            try:
                await script(tested)
            finally:
                tested.stopping.set()

        acting = asyncio.create_task(act())
        try:
            await tested.run()
        finally:
            if not tested.stopping.is_set():
                acting.cancel()
            for one in sockets:
                one.close()
        await acting

    @property
    def received(self) -> list[str]:
        """Messages that the processes have received and written to files so far."""
        file = self.folder / "received"
        return file.read_text().splitlines() if file.exists() else []

    @property
    def started(self) -> list[int]:
        """The ids of the processes that have become ready, in the order of their starts."""
        return [int(line.split()[1]) for line in self.received if line.startswith("started")]

    def notices(self) -> list[str]:
        """Return the notices that have come since the last call."""
        found = []
        while True:
            try:
                found.append(self._notified.recv(1000).decode().partition("\n")[0])
            except BlockingIOError:
                return found


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(WAIT_S):
        while not condition():
            await asyncio.sleep(0.02)


@pytest.fixture
def played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Played]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notified:
        address = f"\0marey-test-{os.getpid()}"
        notified.bind(address)
        notified.setblocking(False)
        monkeypatch.setenv(notices.NOTIFY_VARIABLE, f"@{address[1:]}")
        monkeypatch.setattr(handles, "PROGRAM", "tests.support.pretended_process")
        monkeypatch.setattr(parent, "PAUSES", Backoff(first_s=0.01, longest_s=0.01))
        yield Played(tmp_path, notified)


def test_processes_are_replaced_one_by_one_and_the_workers_move(played: Played) -> None:
    async def script(_: Parent) -> None:
        await until(lambda: len(played.started) == 2)
        await until(lambda: played.notices() == ["READY=1"])
        os.kill(os.getpid(), signal.SIGHUP)
        await until(lambda: len(played.started) == 4)
        noted: list[str] = []

        def is_ready_again() -> bool:
            noted.extend(played.notices())
            return "READY=1" in noted

        await until(is_ready_again)
        assert noted == ["RELOADING=1", "READY=1"]

    asyncio.run(played.play(script))
    assert played.notices() == ["STOPPING=1"]
    first, second, *new = played.started
    assert len({first, second, *new}) == 4
    assert [line.split()[2] for line in played.received if "started" in line] == ["first=True"] + 3 * ["first=False"]
    assert not any("notices=True" in line for line in played.received)
    assert [line for line in played.received if "keep-workers" in line] == [f"{new[0]} keep-workers"]


@pytest.mark.parametrize("workers", [{"local_workers": 1}, {"launcher": "kubernetes", "own_pods": OwnPods()}])
def test_a_process_that_ends_is_started_again_and_another_gets_its_workers(
    played: Played, workers: dict[str, Any]
) -> None:
    async def script(_: Parent) -> None:
        await until(lambda: played.notices() == ["READY=1"])
        os.kill(played.started[0], signal.SIGKILL)
        await until(lambda: len(played.started) == 3)

    asyncio.run(played.play(script, **workers))
    _, second, _ = played.started
    assert [line for line in played.received if "keep-workers" in line] == [f"{second} keep-workers"]


def test_a_new_process_that_does_not_become_ready_replaces_nothing(played: Played) -> None:
    async def script(_: Parent) -> None:
        await until(lambda: played.notices() == ["READY=1"])
        played.behave("fail")
        os.kill(os.getpid(), signal.SIGHUP)
        await until(lambda: played.notices()[-1:] == ["READY=1"])
        assert len(played.started) == 2
        for one in played.started:
            os.kill(one, 0)

    asyncio.run(played.play(script))


def test_a_server_whose_first_process_fails_ends(played: Played) -> None:
    async def script(_: Parent) -> None:
        await asyncio.sleep(WAIT_S)

    played.behave("fail")
    with pytest.raises(ProcessesFailed, match="ended with status 3"):
        asyncio.run(played.play(script))


def test_a_server_whose_processes_die_again_and_again_gives_up(played: Played) -> None:
    async def script(_: Parent) -> None:
        await asyncio.sleep(WAIT_S)

    played.behave("die")
    with pytest.raises(ProcessesFailed, match="5 times in a row, the last time with status 4"):
        asyncio.run(played.play(script))


def test_processes_share_the_limits_of_the_machine(tmp_path: Path) -> None:
    whole = Settings(data=tmp_path, processes=4, database_url="postgresql://db/marey", max_connections=1000)
    share = share_of(whole)
    for name in ("request_memory_bytes", "answer_cache_bytes", "max_connections", "child_requests"):
        assert getattr(share, name) == getattr(whole, name) // 4, name
    assert share.resolved_database_threads == 2
    assert share.child_limits.children == 2
    assert share.host == whole.host


def test_several_processes_need_postgres(tmp_path: Path) -> None:
    with pytest.raises(commands.CommandFailed, match="need Postgres"):
        commands.serve(data=tmp_path / "data", processes=2)
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    "make_loop", [asyncio.new_event_loop, commands._new_event_loop], ids=["asyncio", "of the server"]
)
def test_ctrl_c_in_the_terminal_of_a_server_does_not_reach_its_programs(
    make_loop: Callable[[], asyncio.AbstractEventLoop],
) -> None:
    async def run() -> int:
        leads_group = "import os, sys; sys.exit(0 if os.getpgrp() == os.getpid() else 1)"
        process = await programs.start_program("-c", leads_group, environment={})
        return await process.wait()

    with asyncio.Runner(loop_factory=make_loop) as runner:
        assert runner.run(run()) == 0

"""The async client with a real server: real motion, many calls at a time, cancellation, closing, event loops."""

import asyncio
import contextlib
import inspect
import shutil
import socket
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from tests.support.rest_server import Server

import marey
from marey_client.asynchronous.calls import GRACE_S
from marey_client.asynchronous.project import AsyncProjectHandle
from marey_client.errors import BadArgument, ConnectionClosed, NoSuchPath
from marey_client.handles.clips import ClipHandle
from marey_client.poses.windows import MotionWindows
from marey_schemas.queue.jobs import Job

SOON_S = 5.0
"""Much longer than an interruption takes, and much shorter than what is interrupted here."""
FILES = 5

Program = Callable[[marey.AsyncMarey, AsyncProjectHandle], Coroutine[Any, Any, None]]


@pytest.fixture
def takes(tmp_path: Path, mocap: Path) -> Path:
    """A folder with short real takes of one format."""
    folder = tmp_path / "takes"
    folder.mkdir()
    files = sorted(mocap.glob("cmu-bvh/*.bvh"), key=lambda path: path.stat().st_size)
    for file in files[:FILES]:
        shutil.copy(file, folder)
    return folder


@pytest.fixture
def token(server: Server, monkeypatch: pytest.MonkeyPatch) -> str:
    """The token of the owner of the project `lab`; environment variables contain it, too."""
    made = server.make_project()
    monkeypatch.setenv("MAREY_SERVER", server.address)
    monkeypatch.setenv("MAREY_TOKEN", made)
    return made


@pytest.fixture(autouse=True)
def _no_threads_are_left() -> Iterator[None]:
    yield
    assert [one.name for one in threading.enumerate() if one.name.startswith("marey-async")] == []


def run(program: Program, **options: Any) -> None:
    """Run a program with a client of the server in the environment, and its project `lab`."""

    async def main() -> None:
        async with marey.AsyncMarey(**options) as server:
            await program(server, server.project("lab"))

    asyncio.run(main())


async def wait_for(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(SOON_S):
        while not condition():
            await asyncio.sleep(0.01)


@pytest.mark.usefixtures("token")
def test_real_takes_become_clips_whose_arrays_are_those_of_the_synchronous_client(takes: Path) -> None:
    async def program(server: marey.AsyncMarey, lab: AsyncProjectHandle) -> None:
        report = await lab.upload(takes, collection="raw", shown=False)
        assert f"{FILES} created" in str(report)
        assert "created" in report._repr_html_()
        paths = sorted([clip.path async for clip in report.clips()])
        assert paths == [clip.path async for clip in lab.clips]
        assert await lab.clips.count() == FILES
        chosen = await lab.clips.where("raw", query="frames > 1")
        assert (await chosen.count(), [clip.path async for clip in chosen]) == (FILES, paths)
        clip = await lab.clips[paths[0]]
        assert repr(clip) == f"<async clip {paths[0]!r} {clip.id} revision 1>"
        original = marey.connect().project("lab").clips[paths[0]]
        assert (clip.id, clip.frames, clip.item) == (original.id, original.frames, original.item)
        feet = ["LeftFoot", "RightFoot"]
        found = await clip.positions(joints=feet, frames=slice(0, 20))
        np.testing.assert_array_equal(found, original.positions(joints=feet, frames=slice(0, 20)))
        table = await lab.clips.to_dataframe()
        assert table["path"].tolist() == paths
        motion = await clip.motion()
        await clip.put_motion(motion.model_copy(update={"poses": motion.poses[:10]}), message="shorter")
        assert clip.item.revision == 2
        assert [one.revision async for one in clip.revisions()] == [2, 1]

    run(program)


@pytest.mark.soak
@pytest.mark.usefixtures("token")
def test_two_hundred_reads_at_a_time_give_what_one_after_another_gives(takes: Path) -> None:
    lab = marey.connect().project("lab")
    lab.upload(takes, shown=False)
    expected = [clip.motion(frames=slice(0, 10)).poses for clip in lab.clips]
    most = 0

    async def program(server: marey.AsyncMarey, lab: AsyncProjectHandle) -> None:
        nonlocal most

        async def watch() -> None:
            nonlocal most
            while True:
                most = max(most, server._calls._running)
                await asyncio.sleep(0)

        watching = asyncio.create_task(watch())
        clips = [clip async for clip in lab.clips]
        reads = [clips[number % FILES].motion(frames=slice(0, 10)) for number in range(200)]
        for number, motion in enumerate(await asyncio.gather(*reads)):
            np.testing.assert_array_equal(motion.poses, expected[number % FILES])
        watching.cancel()

    run(program, concurrency=7)
    assert most == 7


@pytest.mark.usefixtures("token")
def test_errors_are_those_of_the_synchronous_client(takes: Path) -> None:
    async def program(server: marey.AsyncMarey, lab: AsyncProjectHandle) -> None:
        await lab.upload(takes, collection="raw", shown=False)
        with pytest.raises(NoSuchPath) as raised:
            await lab.clips["rwa"]
        with pytest.raises(NoSuchPath) as expected:
            marey.connect().project("lab").clips["rwa"]
        assert str(raised.value) == str(expected.value)
        with pytest.raises(BadArgument, match="frames"):
            await (await lab.clips.list().__anext__()).motion(frames=slice(0, 10, 2))
        with pytest.raises(TypeError, match="not iterable"):
            list(lab.clips)  # pyrefly: ignore[bad-argument-type]
        with pytest.raises(TypeError, match="not a container"):
            "raw/walk" in lab.clips  # noqa: B015 # pyrefly: ignore[unsupported-operation]

    run(program)
    with pytest.raises(BadArgument, match="concurrency"):
        marey.AsyncMarey(concurrency=0)


@pytest.mark.usefixtures("token")
def test_jobs_are_submitted_with_handles_and_waiting_for_them_ends_at_once(takes: Path) -> None:
    seen: list[str] = []

    async def program(server: marey.AsyncMarey, lab: AsyncProjectHandle) -> None:
        await lab.upload(takes, shown=False)
        clips = [clip async for clip in lab.clips]
        job = await lab.quality(clips[:2], draws=10)
        assert isinstance(job, Job)
        assert (await lab.job(job.id)).inputs == job.inputs

        async def note(now: Job) -> None:
            await asyncio.sleep(0)
            seen.append(f"{now.state} {threading.current_thread() is threading.main_thread()}")

        waiting = [asyncio.create_task(job.wait(shown=False)) for _ in range(20)]
        watching = asyncio.create_task(job.wait(shown=False, on_progress=note))
        await asyncio.sleep(1.5)
        assert await lab.clips.count() == FILES  # waiting leaves room for other calls
        started = time.monotonic()
        for one in (*waiting, watching):
            one.cancel()
        ended = await asyncio.gather(*waiting, watching, return_exceptions=True)
        assert {type(one) for one in ended} == {asyncio.CancelledError}
        assert time.monotonic() - started < SOON_S
        assert server._calls._live == set()

        again = asyncio.create_task(job.wait(shown=False, require_success=False))
        assert (await job.cancel()).state == "cancelled"
        assert (await again).state == "cancelled"
        with pytest.raises(marey.JobUnsuccessful, match="cancelled"):
            await (await job.refresh()).wait(shown=False)

    run(program, concurrency=2)
    assert "queued True" in seen


@pytest.mark.usefixtures("token")
def test_a_time_limit_ends_a_wait(takes: Path) -> None:
    async def program(server: marey.AsyncMarey, lab: AsyncProjectHandle) -> None:
        await lab.upload(takes, shown=False)
        job = await lab.index()
        started = time.monotonic()
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.3):
                await job.wait(shown=False)
        assert time.monotonic() - started < SOON_S
        assert (await job.refresh()).state == "queued"

    run(program)


@pytest.fixture
def deaf() -> Iterator[socket.socket]:
    """A server that accepts connections and reads nothing."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener


def test_a_cancelled_upload_stops_sending(deaf: socket.socket, tmp_path: Path) -> None:
    large = tmp_path / "large.bin"
    large.write_bytes(bytes(60 << 20))

    async def main() -> None:
        address = f"http://127.0.0.1:{deaf.getsockname()[1]}"
        async with marey.AsyncMarey(address, "marey_token_secret") as server:
            sending = asyncio.create_task(server.blobs.put_file(large))
            connection, _ = await asyncio.to_thread(deaf.accept)
            await asyncio.sleep(0.2)  # the buffers of the connection are full
            started = time.monotonic()
            sending.cancel()
            with pytest.raises(asyncio.CancelledError):
                await sending
            assert time.monotonic() - started < GRACE_S / 2
            assert server._calls._live == set()
            with connection:
                connection.settimeout(SOON_S)
                received = 0
                while chunk := connection.recv(1 << 20):  # ends because the client has closed the connection
                    received += len(chunk)
            assert received < large.stat().st_size

    asyncio.run(main())


def test_a_cancelled_call_is_not_sent_again() -> None:
    asked = 0

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal asked
        with contextlib.suppress(asyncio.IncompleteReadError):  # the client has closed the connection
            while await reader.readuntil(b"\r\n\r\n"):
                asked += 1
                writer.write(b"HTTP/1.1 503 Busy\r\nContent-Length: 0\r\n\r\n")
        writer.close()

    async def main() -> None:
        listener = await asyncio.start_server(answer, "127.0.0.1", 0)
        address = f"http://127.0.0.1:{listener.sockets[0].getsockname()[1]}"
        async with marey.AsyncMarey(address) as server:
            trying = asyncio.create_task(server.me())
            await wait_for(lambda: asked > 1)
            trying.cancel()
            with pytest.raises(asyncio.CancelledError):
                await trying
            before = asked
            await asyncio.sleep(1.5)
            assert asked == before
        listener.close()

    asyncio.run(main())


@pytest.mark.usefixtures("token")
def test_closing_ends_the_calls_that_run_and_those_that_have_not_begun(server: Server, takes: Path) -> None:
    async def main() -> None:
        client = marey.connect_async()
        lab = client.project("lab")
        await lab.upload(takes, shown=False)
        job = await lab.index()
        waiting = [asyncio.create_task(job.wait(shown=False)) for _ in range(3)]
        reading = [asyncio.create_task(lab.read()) for _ in range(50)]
        await asyncio.sleep(0)
        started = time.monotonic()
        await client.close()
        ended = await asyncio.gather(*waiting, *reading, return_exceptions=True)
        assert time.monotonic() - started < SOON_S
        assert {type(one) for one in ended[:3]} == {ConnectionClosed}
        assert ConnectionClosed in {type(one) for one in ended[3:]}
        with pytest.raises(ConnectionClosed, match="client is closed"):
            await lab.read()

    asyncio.run(main())
    port = int(server.address.rpartition(":")[2])
    open_ones = [one for one in psutil.Process().net_connections() if one.raddr and one.raddr.port == port]
    assert open_ones == []


@pytest.mark.usefixtures("token")
def test_event_loops_share_a_client(takes: Path) -> None:
    marey.connect().project("lab").upload(takes, shown=False)
    client = marey.connect_async()
    paths: list[list[str]] = []

    async def read() -> None:
        clips = [clip async for clip in client.project("lab").clips]
        motions = await asyncio.gather(*(clip.motion(frames=slice(0, 2)) for clip in clips))
        assert {len(one.poses) for one in motions} == {2}
        paths.append([clip.path for clip in clips])

    threads = [threading.Thread(target=lambda: asyncio.run(read())) for _ in range(2)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    asyncio.run(read())  # another loop, after the others
    assert len(paths) == 3
    assert paths[0] == paths[1] == paths[2]
    asyncio.run(client.close())


@pytest.mark.usefixtures("token")
def test_a_list_is_read_with_one_call_for_each_page(takes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    marey.connect().project("lab").upload(takes, shown=False)

    async def program(server: marey.AsyncMarey, lab: AsyncProjectHandle) -> None:
        ran: list[str] = []
        run_call = server._calls.run

        async def noted(function: Any, /, *args: Any, **kwargs: Any) -> Any:
            ran.append(function.__name__)
            return await run_call(function, *args, **kwargs)

        monkeypatch.setattr(server._calls, "run", noted)
        assert len([clip async for clip in lab.clips.list(page_size=4)]) == FILES
        assert len(ran) == 3  # two pages, and the end
        listed = lab.clips.list(page_size=2)
        async for _ in listed:
            break
        assert len(ran) == 4

    run(program)


@pytest.mark.usefixtures("token")
def test_functions_of_the_synchronous_sdk_run_with_async_handles(takes: Path) -> None:
    def windows(clips: list[ClipHandle]) -> tuple[int, type[Any]]:
        return len(MotionWindows(clips, frames=2, joints=["Hips"])), type(clips[0])

    async def program(server: marey.AsyncMarey, lab: AsyncProjectHandle) -> None:
        await lab.upload(takes, shown=False)
        clips = [clip async for clip in lab.clips]
        assert (await server.call(windows, clips))[1] is ClipHandle
        first = await server.call(lambda given: given[0], clips)
        assert type(first) is type(clips[0])
        assert inspect.iscoroutinefunction(first.motion)

    run(program)

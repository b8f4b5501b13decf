"""Child processes that read untrusted files: their limits, how callers share them, and how they end."""

import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import psutil
import pytest
from tests.support.patience import PATIENCE_S, wait_until

from marey_schemas.processes.forking import FORKS
from marey_schemas.sizes import MIB
from marey_server.errors import ApiProblem, InvalidProblem, TooLargeProblem, UnavailableProblem
from marey_server.process import children as child_pool
from marey_server.process.children import ChildLimits, Children, ChildTask

FUNCTIONS = "tests.support.child_functions"
ONLY_WITH_FORKS = pytest.mark.skipif(not FORKS, reason="children are only forked on Linux")
LIMITS = ChildLimits(children=2, requests=4, memory_mb=256, processor_s=1, wall_s=PATIENCE_S)


@pytest.fixture(scope="module", params=[False, pytest.param(True, marks=ONLY_WITH_FORKS)], ids=["single", "forked"])
def children(request: pytest.FixtureRequest) -> Iterator[Children]:
    """A pool of two child processes, which load modules themselves or are forked with modules loaded."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MAREY_DATABASE_URL", "postgresql://marey:hunter2@db/marey")
        patch.setenv("MAREY_TOKEN", "hunter2")
        pool = Children(LIMITS, (), forks=request.param)
        yield pool
        pool.close()


def run(pool: Children, function: str, payload: bytes = b"", *, caller: str = "rita") -> bytes:
    """Return the result of a function that runs in a child process."""
    return start(pool, function, payload, caller=caller).future.result(PATIENCE_S)


def start(pool: Children, function: str, payload: bytes = b"", *, caller: str = "rita") -> ChildTask[bytes]:
    """Start a function in a child process, and return its task."""
    return pool.submit(caller, f"{FUNCTIONS}:{function}", lambda: payload, bytes, lambda reason, work: None)


def wait_for(pool: Children, folder: Path, name: str, *, caller: str) -> ChildTask[bytes]:
    """Start a function that waits for a file, wait until a child runs it, and return its task."""
    task = start(pool, "wait_for", str(folder / name).encode(), caller=caller)
    wait_until(lambda: (folder / name).exists() or task.future.done())
    assert not task.future.done(), task.future.exception()
    return task


def let_go(folder: Path, name: str) -> None:
    """Create the file for which a function waits, so that it returns."""
    (folder / f"{name}.go").touch()


def note(ended: list[str], caller: str, _future: object) -> None:
    """Record the caller whose task has ended."""
    ended.append(caller)


def process_id(pool: Children) -> int:
    """Run a short function in a child process, and return the id of this process, which is idle afterwards."""
    found = int(run(pool, "echo").split()[-1])
    wait_until(lambda: pool.sizes == (0, 0))  # otherwise, the next order would get another process
    return found


def test_a_child_stays_for_the_next_order(children: Children) -> None:
    assert process_id(children) == process_id(children)


def test_of_idle_children_the_first_one_gets_the_next_order(children: Children, tmp_path: Path) -> None:
    tasks = [wait_for(children, tmp_path, name, caller=name) for name in ("otto", "olga")]
    processes = {int((tmp_path / name).read_text()) for name in ("otto", "olga")}
    for name in ("olga", "otto"):
        let_go(tmp_path, name)
    assert [task.future.result(PATIENCE_S) for task in tasks] == [b"waited", b"waited"]
    used = set()
    for _ in range(10):
        wait_until(lambda: children.sizes == (0, 0))
        used.add(process_id(children))
    assert len(used) == 1
    assert used < processes


def test_a_renewed_pool_replaces_idle_children_at_once_and_busy_ones_when_their_task_ends(
    children: Children, tmp_path: Path
) -> None:
    tasks = [wait_for(children, tmp_path, name, caller=name) for name in ("otto", "olga")]
    busy, idle = (psutil.Process(int((tmp_path / name).read_text())) for name in ("otto", "olga"))
    let_go(tmp_path, "olga")
    tasks[1].future.result(PATIENCE_S)
    wait_until(lambda: children.sizes == (1, 0))
    children.renew()
    wait_until(lambda: not idle.is_running())
    assert busy.is_running()
    let_go(tmp_path, "otto")
    assert tasks[0].future.result(PATIENCE_S) == b"waited"
    wait_until(lambda: not busy.is_running())
    assert process_id(children) not in (busy.pid, idle.pid)


def test_no_child_sees_a_secret(children: Children) -> None:
    seen = run(children, "environment").decode()
    assert "PATH=" in seen
    assert "hunter2" not in seen


@pytest.mark.parametrize(
    ("function", "kind", "code", "detail", "survives"),
    [
        ("refuse", InvalidProblem, "no-walk", "no walk", True),
        ("fail", ApiProblem, "internal", "log says why", True),
        ("eat", TooLargeProblem, "memory-limit", "256 MiB of memory .*child_memory_mb", False),
        ("burn", TooLargeProblem, "time-limit", "1 s of processor time .*child_processor_s", False),
        ("crash", InvalidProblem, "child-died", "SIGSEGV", False),
    ],
)
def test_each_end_of_an_order_has_its_reason_and_the_next_order_is_carried_out(
    children: Children, tmp_path: Path, function: str, kind: type[ApiProblem], code: str, detail: str, *, survives: bool
) -> None:
    with pytest.raises(kind, match=detail) as caught:
        run(children, "note_and_call", f"{tmp_path / 'process'} {function}".encode())
    assert caught.value.error_code == code
    used = int((tmp_path / "process").read_text())
    wait_until(lambda: psutil.pid_exists(used) is survives)
    process_id(children)


def test_a_child_that_hangs_is_killed(tmp_path: Path) -> None:
    pool = Children(ChildLimits(2, 4, 256, 60, wall_s=0.5), ())
    try:
        with pytest.raises(TooLargeProblem, match=r"0.5 s .*child_wall_s"):
            run(pool, "stop", str(tmp_path / "stopped").encode())
        wait_until(lambda: not psutil.pid_exists(int((tmp_path / "stopped").read_text() or 0)))
    finally:
        pool.close()


def test_what_somebody_kills_fails_and_the_next_order_is_carried_out(children: Children, tmp_path: Path) -> None:
    task = wait_for(children, tmp_path, "walk", caller="rita")
    os.kill(int((tmp_path / "walk").read_text()), signal.SIGKILL)
    with pytest.raises(InvalidProblem, match="SIGKILL"):
        task.future.result(PATIENCE_S)
    assert run(children, "echo", b"next").startswith(b"next ")


def test_a_message_that_needs_too_much_memory_is_refused_as_such() -> None:
    pool = Children(ChildLimits(2, 4, 32, 60, wall_s=PATIENCE_S), ())
    try:
        with pytest.raises(TooLargeProblem, match="32 MiB of memory") as caught:
            run(pool, "echo", bytes(64 * MIB))
        assert caught.value.error_code == "memory-limit"
        assert run(pool, "echo", b"next").startswith(b"next ")
    finally:
        pool.close()


@pytest.mark.parametrize(
    ("kills", "code"), [(1, "memory-limit"), (0, "child-died")], ids=["by the kernel", "by somebody"]
)
def test_a_child_that_the_kernel_killed_says_that_the_machine_ran_out_of_memory(
    children: Children, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kills: int, code: str
) -> None:
    monkeypatch.setattr(children, "_memory_kills", 7)
    monkeypatch.setattr(child_pool, "count_memory_kills", lambda: 7 + kills)
    ended: list[tuple[str, str]] = []
    task = wait_for(children, tmp_path, "walk", caller="rita")
    task.count_stop = lambda reason, work: ended.append((reason, work))
    os.kill(int((tmp_path / "walk").read_text()), signal.SIGKILL)
    with pytest.raises(ApiProblem) as caught:
        task.future.result(PATIENCE_S)
    assert caught.value.error_code == code
    assert ("machine ran out of memory" in caught.value.detail) is bool(kills)
    assert ended == [("memory" if kills else "died", "wait_for")]


def test_one_caller_never_uses_all_children(children: Children, tmp_path: Path) -> None:
    long = wait_for(children, tmp_path, "long", caller="mallory")
    more = start(children, "echo", caller="mallory")
    for word in (b"mine", b"again"):
        assert run(children, "echo", word, caller="rita").startswith(word)
    assert not more.future.done()
    let_go(tmp_path, "long")
    assert (long.future.result(PATIENCE_S), bool(more.future.result(PATIENCE_S))) == (b"waited", True)


def test_callers_take_turns(children: Children, tmp_path: Path) -> None:
    ended: list[str] = []
    blocked = [wait_for(children, tmp_path, name, caller=name) for name in ("otto", "olga")]
    for caller in ("mallory", "mallory", "mallory", "rita"):
        start(children, "echo", caller=caller).future.add_done_callback(partial(note, ended, caller))
    let_go(tmp_path, "otto")
    wait_until(lambda: len(ended) == 4)
    assert ended.index("rita") <= 1
    let_go(tmp_path, "olga")
    assert [task.future.result(PATIENCE_S) for task in blocked] == [b"waited", b"waited"]


def test_work_for_a_client_that_left_is_stopped(children: Children, tmp_path: Path) -> None:
    task = wait_for(children, tmp_path, "walk", caller="rita")
    waiting = start(children, "wait_for", str(tmp_path / "never").encode(), caller="rita")
    waiting.abandon()
    task.abandon()
    process = int((tmp_path / "walk").read_text())
    wait_until(lambda: not psutil.pid_exists(process))
    assert run(children, "echo", b"next").startswith(b"next ")
    assert not (tmp_path / "never").exists()


def test_one_guest_leaves_requests_to_other_guests(children: Children) -> None:
    one = children.request("guests", "192.0.2.1")
    with one, pytest.raises(UnavailableProblem, match=r"^1 of your requests"), children.request("guests", "192.0.2.1"):
        pass
    with children.request("guests", "192.0.2.1"), children.request("guests", "192.0.2.2"):
        pass


def test_requests_are_bounded_together_and_for_each_caller(children: Children) -> None:
    with children.request("mallory"), children.request("mallory"):
        with pytest.raises(UnavailableProblem, match=r"^2 of your requests") as caught, children.request("mallory"):
            pass
        assert (caught.value.error_code, "Retry-After" in caught.value.headers) == ("children-busy", True)
        too_many = pytest.raises(UnavailableProblem, match=r"^4 requests")
        with children.request("rita"), children.request("olga"), too_many, children.request("otto"):
            pass
    with children.request("mallory"), children.request("mallory"):
        pass


def test_a_pool_that_closes_kills_its_children_and_fails_what_waits(tmp_path: Path) -> None:
    pool = Children(LIMITS, ())
    running = wait_for(pool, tmp_path, "walk", caller="rita")
    waiting = start(pool, "echo", caller="rita")
    pool.close()
    for task in (running, waiting):
        with pytest.raises(UnavailableProblem, match="stopping"):
            task.future.result(PATIENCE_S)
    wait_until(lambda: not psutil.pid_exists(int((tmp_path / "walk").read_text())))
    with pytest.raises(UnavailableProblem):
        start(pool, "echo")

"""Child processes that are forked from a process in which the modules that they need are already loaded."""

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from tests.support.patience import wait_until

from marey_schemas.processes.child_process import ChildBroken, ConnectedChild
from marey_schemas.processes.forking import FORKS, LOST, ForkServer

pytestmark = pytest.mark.skipif(not FORKS, reason="children are only forked on Linux")

WAIT_S = 30.0


@pytest.fixture
def server() -> Iterator[ForkServer]:
    started = ForkServer("tests.support.forked_echo")
    started.wait_until_ready()
    yield started
    started.close()


def ids_from(child: ConnectedChild) -> list[int]:
    """Return four ids: the process that loaded the child's module, the child's parent, the child, and its session."""
    child.send(b"who")
    answer = child.receive(WAIT_S)
    assert answer is not None
    return [int(number) for number in answer.split()]


def test_children_have_the_modules_of_the_fork_server_and_a_session_of_their_own(server: ForkServer) -> None:
    children = [server.fork() for _ in range(3)]
    for child in children:
        loaded, parent, own, session = ids_from(child)
        assert loaded == parent
        assert own == session == child.pid
        assert child.alive
    assert len({child.pid for child in children}) == 3
    for child in children:
        child.kill(grace_s=0.0)
        assert not child.alive


@pytest.mark.parametrize(
    ("message", "status"), [(b"exit 7", 7), (b"fail", 1), (None, 0)], ids=["exit", "exception", "closed pipe"]
)
def test_the_exit_status_of_a_child_is_reported(server: ForkServer, message: bytes | None, status: int) -> None:
    child = server.fork()
    if message is None:
        os.kill(child.pid, signal.SIGCONT)
        child._socket.shutdown(2)
    else:
        child.send(message)
    assert child.wait() == status
    child.kill(grace_s=0.0)
    assert ids_from(server.fork())


def test_a_killed_child_is_reported_with_its_signal_and_others_go_on(server: ForkServer) -> None:
    first, second = server.fork(), server.fork()
    first.abort()
    with pytest.raises(EOFError):
        first.receive(WAIT_S)
    assert first.wait() == -signal.SIGKILL
    first.kill(grace_s=0.0)
    assert ids_from(second)[2] == second.pid


def test_a_child_whose_exit_was_not_yet_read_keeps_its_number_and_loses_it_afterwards(server: ForkServer) -> None:
    child = server.fork()
    child.send(b"exit 0")
    assert child.wait() == 0
    assert psutil.Process(child.pid).status() == psutil.STATUS_ZOMBIE
    child.kill(grace_s=0.0)
    wait_until(lambda: not psutil.pid_exists(child.pid))


def test_a_stopped_child_ends_by_kill(server: ForkServer) -> None:
    child = server.fork()
    os.kill(child.pid, signal.SIGSTOP)
    child.kill(grace_s=0.0)
    assert child.wait() == -signal.SIGKILL


def test_all_children_die_with_the_fork_server(server: ForkServer) -> None:
    children = [server.fork() for _ in range(2)]
    server.abort()
    for child in children:
        assert child.wait() == LOST
        child.kill(grace_s=0.0)
    wait_until(lambda: not any(psutil.pid_exists(child.pid) for child in children))
    assert not server.alive
    with pytest.raises(ChildBroken):
        server.fork()


def test_children_outlive_the_thread_that_started_the_fork_server() -> None:
    server = ForkServer("tests.support.forked_echo")
    thread = threading.Thread(target=server.wait_until_ready)
    thread.start()
    thread.join()
    child = server.fork()
    assert ids_from(child)[2] == child.pid
    server.close()
    wait_until(lambda: not psutil.pid_exists(child.pid))


def test_a_socket_that_cannot_be_passed_ends_the_fork_server_and_nobody_waits(
    server: ForkServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError("no descriptor is left")

    with monkeypatch.context() as patch:
        patch.setattr("marey_schemas.processes.child_process.socket.send_fds", fail)
        with pytest.raises(ChildBroken):
            server.fork()
    assert not server.alive


def test_a_child_that_ends_before_it_is_ready_leaves_no_zombie(
    server: ForkServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    pids = []

    def end_early(child: ConnectedChild) -> None:
        pids.append(child.pid)
        os.kill(child.pid, signal.SIGKILL)
        raise ChildBroken(child.wait())

    with monkeypatch.context() as patch:
        patch.setattr(ConnectedChild, "wait_until_ready", end_early)
        with pytest.raises(ChildBroken):
            server.fork()
    wait_until(lambda: not psutil.pid_exists(pids[0]))
    assert ids_from(server.fork())


def test_numeric_libraries_of_a_fork_server_have_one_thread_whatever_the_environment_says(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    server = ForkServer("tests.support.forked_echo", ["numeric"])
    server.wait_until_ready()
    assert ids_from(server.fork())
    server.close()


def test_many_threads_fork_at_the_same_time(server: ForkServer) -> None:
    answers: list[list[int]] = []

    def use() -> None:
        for _ in range(5):
            child = server.fork()
            answers.append(ids_from(child))
            child.kill(grace_s=0.0)

    threads = [threading.Thread(target=use) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(answers) == 30
    assert all(own == session for _, _, own, session in answers)


def test_a_fork_that_fails_is_reported_and_the_next_one_succeeds() -> None:
    server = ForkServer("tests.support.forked_echo", ["full"])
    server.wait_until_ready()
    with pytest.raises(ChildBroken):
        server.fork()
    assert ids_from(server.fork())
    server.close()


def test_a_process_with_a_second_thread_forks_nothing() -> None:
    server = ForkServer("tests.support.forked_echo", ["threaded"])
    server.wait_until_ready()
    with pytest.raises(ChildBroken):
        server.fork()
    server.close()


def test_threads_that_worked_while_modules_were_loaded_may_end_a_moment_later() -> None:
    server = ForkServer("tests.support.forked_echo", ["ending"])
    server.wait_until_ready()
    assert ids_from(server.fork())
    server.close()


def test_a_fork_server_that_ends_while_it_loads_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ChildBroken) as broken:
        ForkServer("tests.support.forked_echo", ["broken"]).wait_until_ready()
    assert broken.value.status == 3

"""Child processes in which the server reads untrusted files and computes.

The number of children is limited, and users share them fairly. Each child has a thread in the server, which starts the
child, sends it one task after another, and replaces it. A free child gets a task of the caller who uses the fewest
children; no caller can use all of them.
"""

from __future__ import annotations

import logging
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, InvalidStateError
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from marey_schemas.processes.child_process import BadMessage, ChildBroken, ConnectedChild
from marey_schemas.processes.forking import FORKS, LOST
from marey_schemas.processes.limits import OUT_OF_MEMORY, count_memory_kills
from marey_schemas.sizes import MIB
from marey_server.errors import (
    ApiProblem,
    InvalidProblem,
    NotFoundProblem,
    StoppingProblem,
    TooLargeProblem,
    UnavailableProblem,
)
from marey_server.motions.child import ChildAnswer, ChildOrder, ChildRefusal
from marey_server.process.child_starting import LOADED_FIRST, ChildStarter

T = TypeVar("T")

ORDERS_PER_CHILD = 1000
"""Number of tasks after which a child process is replaced, so that memory leaks of libraries do not add up."""
ABANDONED_S = 1.0
"""Time in seconds that a task may still run after its client has disconnected; replacing its child takes longer."""
CLOSING_S = 10.0
ASK_AGAIN_S = 5
"""Time in seconds after which a refused client may try again."""
JOB_ADVICE = "split the request, or submit a job, which has higher limits"
_PROBLEMS = {one.status: one for one in (InvalidProblem, NotFoundProblem, TooLargeProblem)}

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ChildLimits:
    """Limits of all child processes together, and limits of each task.

    Parameters
    ----------
    children : greatest number of child processes
    requests : greatest number of requests that use a child or wait for one
    memory_mb : memory in MiB that a task may use
    processor_s, wall_s : greatest processor time and greatest duration of a task, in seconds
    """

    children: int
    requests: int
    memory_mb: int
    processor_s: float
    wall_s: float

    @property
    def children_each(self) -> int:
        """Greatest number of children that one caller uses at the same time."""
        return max(1, self.children - 1)

    @property
    def requests_each(self) -> int:
        """Greatest number of requests of one caller that use children or wait for one."""
        return max(1, self.requests // 2)

    @property
    def requests_of_guest(self) -> int:
        """Greatest number of requests of one guest that use children or wait for one.

        All guests together count as one caller. One guest may have half of the requests of this caller, but at least
        one.
        """
        return max(1, self.requests_each // 2)


@dataclass(eq=False)
class ChildTask(Generic[T]):
    """Call of a function, named `module:function`, in a child process.

    `make` creates the bytes that the function receives as its argument. `read` converts the bytes that the function
    returns to the result of the task.
    """

    caller: str
    function: str
    make: Callable[[], bytes]
    read: Callable[[bytes], T]
    count_stop: Callable[[str, str], None]
    """Function that is called with a reason and the name of `function` if the child ends before the task does."""
    future: Future[T] = field(default_factory=Future)
    stopped: str = ""
    """Reason why the child was killed: `time`, `client-gone` or `closing`."""
    _child: ConnectedChild | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def assign(self, child: ConnectedChild | None) -> None:
        """Set the child that runs this task; None when the task has ended."""
        with self._lock:
            self._child = child

    def stop(self, reason: str) -> None:
        """Kill the child that runs this task, if there is one."""
        with self._lock:
            if self._child is not None and not self.stopped:
                self.stopped = reason
                self._child.abort()

    def abandon(self) -> None:
        """Cancel the task, because its client has closed the connection.

        If a child is still running the task after `ABANDONED_S`, the child is killed.
        """
        if self.future.cancel():
            _after(ABANDONED_S, self.stop, "client-gone")

    def succeed(self, payload: bytes) -> None:
        """End the task with the result `read(payload)`, or with the error that `read` raises.

        `payload` is the child's answer.
        """
        try:
            result = self.read(payload)
        except Exception as error:  # noqa: BLE001 - whoever waits for the task gets it
            self.fail(error)
            return
        with suppress(InvalidStateError):
            self.future.set_result(result)

    def count_end(self, reason: str) -> None:
        """Count one more child that ended while it ran this task."""
        self.count_stop(reason, self.function.partition(":")[2])

    def fail(self, error: Exception) -> None:
        """End the task with an error, which is raised where the result is awaited."""
        with suppress(InvalidStateError):
            self.future.set_exception(error)


class Children:
    """Pool of child processes; each is started when it is first needed."""

    def __init__(self, limits: ChildLimits, loaded_first: Sequence[str] = LOADED_FIRST, *, forks: bool = FORKS) -> None:
        self.limits = limits
        self._starter = ChildStarter(limits.memory_mb * MIB, loaded_first, forks=forks)
        self._changed = threading.Condition()
        self._waiting: list[ChildTask[Any]] = []
        self._running: list[ChildTask[Any]] = []
        self._requests: Counter[str] = Counter()
        self._guests: Counter[str] = Counter()
        self._turns: dict[str, int] = {}
        """Number of the turn in which each caller last got a child.

        Of the callers that use equally many children, the one with the lowest number is next.
        """
        self._turn = 0
        self._threads: list[threading.Thread] = []
        self._idle: set[int] = set()
        """Numbers of the children that wait for a task."""
        self._closed = False
        self._generation = 0
        """Number of renewals; a child that was started before the last renewal gets no further task."""
        self._memory_kills = count_memory_kills()

    @property
    def sizes(self) -> tuple[int, int]:
        """The number of tasks that run in children, and the number of tasks that wait for a child."""
        return len(self._running), len(self._waiting)

    @contextmanager
    def request(self, caller: str, guest: str = "") -> Iterator[None]:
        """Count a request of a caller, and of a guest if one is given, while the `with` block runs.

        Raises `UnavailableProblem` if too many requests already use a child process or wait for one.
        """
        with self._changed:
            if self._requests[caller] >= self.limits.requests_each:
                raise _busy(self._requests[caller], own=True)
            if guest and self._guests[guest] >= self.limits.requests_of_guest:
                raise _busy(self._guests[guest], own=True)
            if self._requests.total() >= self.limits.requests:
                raise _busy(self._requests.total(), own=False)
            self._requests[caller] += 1
            self._guests[guest] += 1
        try:
            yield
        finally:
            with self._changed:
                self._guests[guest] -= 1
                self._guests += Counter()  # drops guests without a request
                self._requests[caller] -= 1
                if not self._requests[caller]:
                    del self._requests[caller]
                    self._turns.pop(caller, None)

    def submit(
        self,
        caller: str,
        function: str,
        make: Callable[[], bytes],
        read: Callable[[bytes], T],
        count_stop: Callable[[str, str], None],
    ) -> ChildTask[T]:
        """Call `function` (`module:name`) in a child process.

        `make` returns the argument as bytes; `read` converts the answer to the result of the task. Raises
        `StoppingProblem` if the server is stopping.
        """
        task = ChildTask(caller, function, make, read, count_stop)
        with self._changed:
            if self._closed:
                raise StoppingProblem
            self._waiting.append(task)
            callers = Counter(task.caller for task in (*self._waiting, *self._running))
            if sum(min(count, self.limits.children_each) for count in callers.values()) > len(self._threads):
                self._start_thread()
            self._changed.notify_all()
        return task

    def warm(self) -> None:
        """Start as many children as one caller may use; the others are started when several callers need them."""
        with self._changed:
            while not self._closed and len(self._threads) < self.limits.children_each:
                self._start_thread()

    def renew(self) -> None:
        """Replace all children, those with a task when it ends, so that no child keeps data of earlier tasks."""
        with self._changed:
            self._generation += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Kill all children; their tasks and all waiting tasks fail."""
        with self._changed:
            self._closed = True
            left, self._waiting = self._waiting, []
            for task in self._running:
                task.stop("closing")
            self._changed.notify_all()
        for task in left:
            task.fail(StoppingProblem())
        self._starter.close()
        for thread in self._threads:
            thread.join(CLOSING_S)

    def _start_thread(self) -> None:
        if len(self._threads) == self.limits.children:
            return
        number = len(self._threads) + 1
        thread = threading.Thread(target=self._work, args=[number], name=f"marey-child-{number}", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _eligible(self) -> list[ChildTask[Any]]:
        """Return the waiting tasks of callers who may use one more child; first remove cancelled tasks."""
        self._waiting = [task for task in self._waiting if not task.future.cancelled()]
        using = Counter(task.caller for task in self._running)
        return [task for task in self._waiting if using[task.caller] < self.limits.children_each]

    # -- the thread of one child --

    def _work(self, number: int) -> None:
        """Run tasks in one child after the other until the pool is closed."""
        while not self._closed:
            self._use_child(number)

    def _use_child(self, number: int) -> None:
        """Start a child, and run tasks in it until it is replaced; a child that has ended is replaced at once."""
        generation = self._generation
        child, orders, usable = self._started(), 0, True
        while usable and (task := self._next_task(number, generation)) is not None:
            if child is None or not child.alive:
                _discard(child)
                child, orders = self._started(), 0
            orders += 1
            usable = child is not None and self._perform(task, child) and orders < ORDERS_PER_CHILD
            if child is None:
                task.fail(UnavailableProblem("The server cannot start a child process; its log says why."))
            with self._changed:
                self._running.remove(task)
                if usable:
                    self._idle.add(number)
                self._changed.notify_all()
        _discard(child)

    def _started(self) -> ConnectedChild | None:
        """Return a new child that is ready, or None if it cannot be started."""
        try:
            return self._starter.start()
        except (ChildBroken, OSError, RuntimeError) as error:  # no process, descriptor, memory or thread is left
            if not self._closed:
                log.error("a child process cannot be started: %s", error)
            return None

    def _next_task(self, number: int, generation: int) -> ChildTask[Any] | None:
        """Wait for the next task of the child with this number; None if the pool is closed or renewed.

        A task goes to the idle child with the lowest number, whose caches most likely contain what the task needs.
        """
        with self._changed:
            self._idle.add(number)
            while not self._closed and generation == self._generation:
                eligible = self._eligible()
                if len(eligible) > sum(other < number for other in self._idle):
                    using = Counter(task.caller for task in self._running)
                    task = min(eligible, key=lambda one: (using[one.caller], self._turns.get(one.caller, 0)))
                    self._waiting.remove(task)
                    self._running.append(task)
                    self._idle.remove(number)
                    self._turn += 1
                    self._turns[task.caller] = self._turn
                    return task
                self._changed.wait()
            self._idle.remove(number)
        return None

    def _perform(self, task: ChildTask[Any], child: ConnectedChild) -> bool:
        """Run a task in a child; return whether the child can run another task."""
        try:
            order = ChildOrder(function=task.function, payload=task.make(), processor_s=self.limits.processor_s).pack()
        except Exception as error:  # noqa: BLE001 - whoever waits for the task gets it
            task.fail(error)
            return True
        task.assign(child)
        if self._closed:
            task.stop("closing")
        timer = _after(self.limits.wall_s, task.stop, "time")
        try:
            child.send(order)
            outcome = ChildAnswer.unpack(child.receive() or b"")
        except (EOFError, OSError):
            child.abort()
            task.fail(self._problem_of_end(task, child.wait()))
            return False
        except BadMessage as error:
            log.error("%s", error)
            task.fail(ApiProblem("A child process of the server failed; the server's log says why."))
            return False
        finally:
            timer.cancel()
            task.assign(None)
        self._report_outcome(task, outcome)
        return not task.stopped and not outcome.out_of_memory

    def _report_outcome(self, task: ChildTask[Any], outcome: ChildAnswer) -> None:
        if outcome.out_of_memory:
            task.count_end("memory")
            task.fail(self._too_much_memory())
        elif outcome.refusal is not None:
            task.fail(_as_error(outcome.refusal))
        elif outcome.traceback:
            log.error("%s failed in a child process:\n%s", task.function, outcome.traceback)
            task.fail(ApiProblem("The server failed to carry out this request; its log says why."))
        else:
            task.succeed(outcome.payload)

    def _problem_of_end(self, task: ChildTask[Any], status: int) -> ApiProblem:
        """Return the error for a task whose child process ended with the exit status `status` during the task.

        Also count the end in the metrics.
        """
        if task.stopped == "closing":
            return StoppingProblem()
        if status == LOST:
            task.count_end("died")
            return UnavailableProblem("The child process of this request ended unexpectedly; try again.")
        if status == OUT_OF_MEMORY:
            task.count_end("memory")
            return self._too_much_memory()
        if status == -signal.SIGKILL and not task.stopped and self._kernel_lacked_memory():
            task.count_end("memory")
            return TooLargeProblem(
                f"The machine ran out of memory, so the system killed the child process of this request; {JOB_ADVICE}.",
                code="memory-limit",
            )
        out_of_time = status == -signal.SIGXCPU
        task.count_end(task.stopped or ("time" if out_of_time else "died"))
        if task.stopped == "time":
            return _too_long(f"{self.limits.wall_s:g} s", "child_wall_s")
        if out_of_time:
            return _too_long(f"{self.limits.processor_s:g} s of processor time", "child_processor_s")
        ended = f"was ended by {_signal_name(-status)}" if status < 0 else f"ended with status {status}"
        return InvalidProblem(
            f"The child process of this request {ended}; the data may be damaged, or need too much memory.",
            code="child-died",
        )

    def _kernel_lacked_memory(self) -> bool:
        """Return whether the kernel has killed a process for lack of memory since the last call of this method."""
        before, self._memory_kills = self._memory_kills, count_memory_kills()
        return self._memory_kills > before

    def _too_much_memory(self) -> ApiProblem:
        return TooLargeProblem(
            f"This request needs more than the limit of {self.limits.memory_mb} MiB of memory for one request "
            f"(child_memory_mb); {JOB_ADVICE}.",
            code="memory-limit",
        )


def _after(seconds: float, function: Callable[[str], None], argument: str) -> threading.Timer:
    timer = threading.Timer(seconds, function, [argument])
    timer.daemon = True
    timer.start()
    return timer


def _discard(child: ConnectedChild | None) -> None:
    if child is not None:
        child.kill(grace_s=0.0)


def _busy(count: int, *, own: bool) -> UnavailableProblem:
    which = f"{count} of your requests" if own else f"{count} requests"
    return UnavailableProblem(
        f"{which} already use the child processes of the server or wait for one; try again in a few seconds.",
        code="children-busy",
        headers={"Retry-After": str(ASK_AGAIN_S)},
    )


def _too_long(limit: str, setting: str) -> TooLargeProblem:
    return TooLargeProblem(
        f"This request takes longer than the limit of {limit} for one request ({setting}); {JOB_ADVICE}.",
        code="time-limit",
    )


def _as_error(problem: ChildRefusal) -> ApiProblem:
    kind = _PROBLEMS.get(problem.status, InvalidProblem)
    return kind(problem.detail, code=problem.code, errors=problem.errors)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"

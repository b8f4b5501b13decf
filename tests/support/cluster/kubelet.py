"""Kubelet of the stub cluster: runs the containers of pods as local processes."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import os
import re
import shutil
import signal
import sys
from asyncio.subprocess import Process
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tests.support.awaited_programs import AwaitedProgram
from tests.support.cluster.objects import Document, Objects, Refused, condition, now, set_condition
from tests.support.forked_programs import start_program

MAREY = (sys.executable, "-m", "marey_client.cli")
"""Command that the entry point of the images runs."""
SCRIPT = (sys.executable, "-I", "-S", "-c")
"""Command that runs Python code without the installed packages, whose lookup takes most of the starting time."""
GRACE_S = 30.0


@dataclass
class Kubelet:
    """Starts and stops the processes of pods, and reports their states.

    Each mounted volume is a folder below `folder`; paths in the arguments and variables of a container are replaced
    accordingly. `images` names the command of each image.
    """

    objects: Objects
    folder: Path
    images: dict[str, tuple[str, ...]] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=dict)
    paused: bool = False
    """Whether no pod is started."""
    new_processes: bool = False
    """Whether modules run in new processes, which `/proc` shows with their own variables, instead of forked ones."""
    processes: dict[str, Process | AwaitedProgram] = field(default_factory=dict)
    commands: list[tuple[list[str], dict[str, str]]] = field(default_factory=list)
    """Arguments and variables of all processes that were started."""
    _running: dict[str, asyncio.Task[None]] = field(default_factory=dict)
    _killed: dict[str, str] = field(default_factory=dict)

    def step(self) -> None:
        """Start the pods that wait, stop those that were deleted, and remove those that have ended.

        The controllers have seen every pod that is removed here.
        """
        for pod in self.objects.select("pods"):
            name = pod["metadata"]["name"]
            if name in self._running:
                if "deletionTimestamp" in pod["metadata"]:
                    self._terminate(name)
            elif "deletionTimestamp" in pod["metadata"]:
                self.objects.delete("pods", name)
            elif pod["status"]["phase"] == "Pending" and not self.paused and self._can_start(pod):
                self._running[name] = asyncio.create_task(self._run(pod))

    def kill(self, pod: str, reason: str = "Error") -> None:
        """Kill the process of a pod; its status gives the reason, such as OOMKilled."""
        self._killed[pod] = reason
        os.killpg(self.processes[pod].pid, signal.SIGKILL)

    def evict(self, pod: str, reason: str = "EvictionByEvictionAPI") -> None:
        """End a pod, as a cluster does if it needs the node of the pod."""
        self.objects.change("pods", pod, lambda one: set_condition(one, "DisruptionTarget", True, reason))
        self._terminate(pod)

    async def close(self) -> None:
        """Kill all processes."""
        for process in self.processes.values():
            if process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
        for task in list(self._running.values()):
            task.cancel()
        await asyncio.gather(*self._running.values(), return_exceptions=True)
        for process in self.processes.values():
            await process.wait()

    def log_of(self, pod: str) -> str:
        """Return the output of a pod."""
        file = self.folder / f"{pod}.log"
        return file.read_text(encoding="utf-8") if file.exists() else ""

    def _can_start(self, pod: Document) -> bool:
        """Return whether the image and all Secrets exist; otherwise, the status of the container gives the reason."""
        (container,) = pod["spec"]["containers"]
        if container["image"] not in self.images:
            self._report_waiting(pod, "ErrImagePull", f"{container['image']}: not found")
            return False
        for volume in pod["spec"].get("volumes", ()):
            with contextlib.suppress(KeyError):
                try:
                    self.objects.read("secrets", volume["secret"]["secretName"])
                except Refused:
                    self._report_waiting(pod, "ContainerCreating")
                    return False
        return True

    def _report_waiting(self, pod: Document, reason: str, message: str = "") -> None:
        waiting = {"waiting": {"reason": reason, "message": message}}
        self._report(pod, "Pending", waiting)

    def _report(self, pod: Document, phase: str, state: Document, restarts: int = 0) -> None:
        (container,) = pod["spec"]["containers"]
        own = {"name": container["name"], "image": container["image"], "restartCount": restarts, "state": state}
        with contextlib.suppress(Refused):
            self.objects.change(
                "pods",
                pod["metadata"]["name"],
                lambda one: one["status"].update({"phase": phase, "containerStatuses": [own]}),
            )

    async def _run(self, pod: Document) -> None:
        """Run the container of a pod until it ends for good, and report its states."""
        name = pod["metadata"]["name"]
        restarts = 0
        try:
            while True:
                started = now()
                process = await self._start(pod)
                self._report(pod, "Running", {"running": {"startedAt": started}}, restarts)
                overdue = self._kill_when_overdue(pod)
                status = await process.wait()
                overdue.cancel()
                ended = _ended(status, started, self._killed.pop(name, None))
                present = self.objects.read("pods", name)
                over = "deletionTimestamp" in present["metadata"] or condition(present, "DisruptionTarget")
                if pod["spec"].get("restartPolicy", "Always") != "Always" or over:
                    break
                restarts += 1
            self._report(pod, "Succeeded" if status == 0 else "Failed", {"terminated": ended}, restarts)
        finally:
            del self._running[name]

    def _kill_when_overdue(self, pod: Document) -> asyncio.TimerHandle:
        """Schedule the end of a pod at its deadline, which its status then gives as the reason."""
        name = pod["metadata"]["name"]
        reason = {"reason": "DeadlineExceeded", "message": "Pod was active on the node longer than the deadline"}

        def end() -> None:
            self.objects.change("pods", name, lambda one: one["status"].update(reason))
            self._terminate(name)

        seconds = pod["spec"].get("activeDeadlineSeconds", 10**6)
        return asyncio.get_running_loop().call_later(seconds, end)

    async def _start(self, pod: Document) -> Process | AwaitedProgram:
        name = pod["metadata"]["name"]
        (container,) = pod["spec"]["containers"]
        places = self._mount(pod)
        variables = _variables(pod)
        words = [_placed(_expanded(word, variables), places) for word in container.get("args", ())]
        command = [*self.images[container["image"]], *words]
        inherited = {key: os.environ[key] for key in ("PATH", "PYTHONPATH", "NUMBA_CACHE_DIR") if key in os.environ}
        own = {key: _placed(text, places) for key, text in variables.items()}
        environment = inherited | {"HOME": places["/tmp"], "TMPDIR": places["/tmp"]} | self.environment | own
        self.commands.append((command, environment))
        with (self.folder / f"{name}.log").open("ab") as log:
            process: Process | AwaitedProgram
            if command[:2] == [sys.executable, "-m"] and not self.new_processes:
                process = await start_program(
                    *command[1:], environment=environment, output=log.fileno(), own_group=True
                )
            else:
                process = await asyncio.create_subprocess_exec(
                    *command, env=environment, stdin=asyncio.subprocess.DEVNULL, stdout=log, stderr=log,
                    start_new_session=True,
                )  # fmt: skip
        self.processes[name] = process
        return process

    def _mount(self, pod: Document) -> dict[str, str]:
        """Create the volumes of a pod; return their folders by the paths in the container."""
        name = pod["metadata"]["name"]
        volumes = {volume["name"]: volume for volume in pod["spec"].get("volumes", ())}
        places = {}
        for mount in pod["spec"]["containers"][0].get("volumeMounts", ()):
            place = self.folder / name / mount["name"]
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir(parents=True)
            places[mount["mountPath"]] = str(place)
            if (source := volumes[mount["name"]].get("secret")) is not None:
                self._write_secret(place, source)
        return places

    def _write_secret(self, place: Path, source: Document) -> None:
        """Write the files of a Secret as a kubelet does: behind a link, readable for the group of the pod."""
        data = place / "..data"
        real = place / "..2026_11_28"
        real.mkdir()
        data.symlink_to(real.name)
        for key, text in self.objects.read("secrets", source["secretName"])["data"].items():
            (real / key).write_bytes(base64.b64decode(text))
            (real / key).chmod(source["defaultMode"] | 0o040)
            (place / key).symlink_to(Path("..data", key))

    def _terminate(self, pod: str) -> None:
        """Send SIGTERM to the process of a pod, and SIGKILL after the grace period."""
        process = self.processes.get(pod)
        if process is None or process.returncode is not None or pod in self._killed:
            return
        self._killed[pod] = "Error"
        process.terminate()
        asyncio.get_running_loop().call_later(GRACE_S, self._kill_late, process)

    def _kill_late(self, process: Process | AwaitedProgram) -> None:
        if process.returncode is None:
            process.kill()


def _ended(status: int, started: str, reason: str | None) -> Document:
    code = 128 - status if status < 0 else status
    usual = "Completed" if code == 0 else "Error"
    return {"exitCode": code, "reason": reason if reason == "OOMKilled" else usual, "startedAt": started,
            "finishedAt": now()}  # fmt: skip


def _variables(pod: Document) -> dict[str, str]:
    """Return the variables of the container, those from fields of the pod included."""
    fields: dict[str, Callable[[], str]] = {"metadata.name": lambda: str(pod["metadata"]["name"])}
    found = {}
    for one in pod["spec"]["containers"][0].get("env", ()):
        source = one.get("valueFrom", {}).get("fieldRef", {}).get("fieldPath")
        found[one["name"]] = one["value"] if source is None else fields[source]()
    return found


def _expanded(word: str, variables: dict[str, str]) -> str:
    """Return an argument in which `$(NAME)` is replaced by the variable."""
    return re.sub(r"\$\((\w+)\)", lambda match: variables.get(match[1], match[0]), word)


def _placed(text: str, places: dict[str, str]) -> str:
    """Return a text in which a path in the container is replaced by the path of this machine."""
    for path, place in places.items():
        if text == path or text.startswith(f"{path}/"):
            return place + text.removeprefix(path)
    return text

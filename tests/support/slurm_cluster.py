"""A real Slurm cluster on this machine: controller, node daemon and munge, as Debian packages them, for one user.

`tests/support/install_slurm.sh` installs the programs. The tests run only on machines that have these programs.
"""

from __future__ import annotations

import getpass
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
from tests.support.patience import PATIENCE_S
from tests.support.server_process import reserved_port
from tests.support.tiers import SLURM_DAEMONS, SYSTEM_PATH

END_S = 30.0
"""Longest wait in seconds until cancelled jobs have ended; Slurm kills them 5 seconds after their cancellation."""
CPUS = 4
MEMORY_MB = 8000
STORED_WITHIN_S = 6.0
"""Seconds within which the controller stores a change of a job."""


class SlurmCluster:
    """Daemons of a cluster with one node; `settings` replace lines of its configuration."""

    def __init__(self, folder: Path, **settings: str) -> None:
        self.folder = folder
        self.configuration = folder / "slurm.conf"
        self._daemons: list[subprocess.Popen[bytes]] = []
        for name in ("state", "spool"):
            (folder / name).mkdir()
        (folder / "munge.key").write_bytes(os.urandom(1024))
        (folder / "munge.key").chmod(0o600)
        self._write_configuration(settings)

    def start(self) -> None:
        """Start the daemons, and wait until the node accepts jobs."""
        self._spawn("munged", *self._munge_options(), "--foreground", "--force")
        self._until((self.folder / "munge.socket").exists)
        self.start_controller()
        self.start_node()
        self._until(lambda: "idle" in self.ask("sinfo", "--noheader", "--format=%T"))

    def start_node(self) -> None:
        """Start the node daemon, which finds the job steps that it left behind."""
        self.node = self._spawn("slurmd", "-D", "-f", str(self.configuration))

    def start_controller(self) -> None:
        """Start the controller, which continues with the state that it stored."""
        self.controller = self._spawn("slurmctld", "-D", "-f", str(self.configuration))
        self._until(lambda: "UP" in self.ask("scontrol", "ping"))

    def kill_controller(self) -> None:
        """Kill the controller after it has had the time to store the present jobs.

        A controller that does not know a running job starts the job, or another one with the same id, a second time;
        then the node is drained because of the duplicate id.
        """
        time.sleep(STORED_WITHIN_S)
        self.controller.kill()
        self.controller.wait()

    def stop(self) -> None:
        """End all jobs, then the daemons, beginning with the one that was started last, and at last the job steps."""
        if sum(daemon.poll() is None for daemon in self._daemons) == len(SLURM_DAEMONS):
            self._end_jobs()
        for daemon in reversed(self._daemons):
            if daemon.poll() is None:
                daemon.terminate()
                try:
                    daemon.wait(PATIENCE_S)
                except subprocess.TimeoutExpired:
                    daemon.kill()
                    daemon.wait()
        for step in self.steps():
            for process in (step, *step.children(recursive=True)):
                with suppress(psutil.NoSuchProcess):
                    process.kill()

    def steps(self) -> list[psutil.Process]:
        """Return the running processes `slurmstepd` of this cluster; each has a socket in the folder of its node.

        They outlive the daemons, and wait until the controller has received how their jobs ended.
        """
        spool = f"{self.folder / 'spool'}/"
        sockets = [one for one in psutil.net_connections("unix") if str(one.laddr).startswith(spool)]
        return [psutil.Process(pid) for pid in {one.pid for one in sockets if one.pid is not None}]

    def _end_jobs(self) -> None:
        """Cancel all jobs, and wait until they have ended: a node waits long for jobs whose controller is gone."""
        self.ask("scancel", "--me")
        deadline = time.monotonic() + END_S
        while self.ask("squeue", "--noheader").strip() and time.monotonic() < deadline:
            time.sleep(0.2)

    def ask(self, program: str, *arguments: str) -> str:
        """Return the output of a command of Slurm, also if the command fails."""
        environment = {**os.environ, "SLURM_CONF": str(self.configuration)}
        done = subprocess.run(
            [program, *arguments], env=environment, capture_output=True, text=True, timeout=PATIENCE_S
        )
        return done.stdout + done.stderr

    def _munge_options(self) -> Iterator[str]:
        files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
        yield from (f"--{option}={self.folder}/munge.{ending}" for option, ending in files.items())

    def _spawn(self, program: str, *arguments: str) -> subprocess.Popen[bytes]:
        path = shutil.which(program, path=SYSTEM_PATH)
        assert path is not None
        with (self.folder / f"{program}.out").open("ab") as output:
            daemon = subprocess.Popen([path, *arguments], stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        self._daemons.append(daemon)
        return daemon

    def _until(self, reached: object) -> None:
        assert callable(reached)
        deadline = time.monotonic() + PATIENCE_S
        while not reached():
            logs = "\n".join(f"{file}:\n{file.read_text()[-2000:]}" for file in self.folder.glob("*.out"))
            assert time.monotonic() < deadline, f"Slurm did not start:\n{logs}"
            time.sleep(0.1)

    def _write_configuration(self, settings: Mapping[str, str]) -> None:
        host, folder = socket.gethostname().partition(".")[0], self.folder
        lines = {
            "ClusterName": "marey",
            "SlurmctldHost": f"{host}(127.0.0.1)",
            "SlurmUser": getpass.getuser(),
            "SlurmdUser": getpass.getuser(),
            "SlurmctldPort": str(reserved_port()),
            "SlurmdPort": str(reserved_port()),
            "AuthType": "auth/munge",
            "AuthInfo": f"socket={folder}/munge.socket,cred_expire=15",  # also the pause before a task is run again
            "StateSaveLocation": f"{folder}/state",
            "SlurmdSpoolDir": f"{folder}/spool",
            "SlurmctldPidFile": f"{folder}/slurmctld.pid",
            "SlurmdPidFile": f"{folder}/slurmd.pid",
            "ProctrackType": "proctrack/linuxproc",
            "TaskPlugin": "task/none",
            "JobAcctGatherType": "jobacct_gather/none",
            "SelectType": "select/cons_tres",
            "SelectTypeParameters": "CR_CPU_Memory",
            "SlurmdParameters": "config_overrides",
            "MpiDefault": "none",
            "ReturnToService": "2",
            "DefMemPerCPU": "512",
            "KillWait": "5",
            "MinJobAge": "300",
            **settings,
        }
        text = "".join(f"{name}={value}\n" for name, value in lines.items())
        text += f"NodeName={host} NodeAddr=127.0.0.1 CPUs={CPUS} RealMemory={MEMORY_MB} Features=fast State=UNKNOWN\n"
        text += "PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP\n"
        text += "PartitionName=night Nodes=ALL MaxTime=INFINITE State=UP\n"
        self.configuration.write_text(text)


@contextmanager
def running_cluster(folder: Path, **settings: str) -> Iterator[SlurmCluster]:
    """Run a cluster while the `with` block runs."""
    cluster = SlurmCluster(folder, **settings)
    try:
        cluster.start()
        yield cluster
    finally:
        cluster.stop()

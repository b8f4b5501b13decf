"""Settings of the processes of a server: processes that share its port, and child processes that compute."""

from __future__ import annotations

import os

from pydantic import Field
from pydantic_settings import BaseSettings

from marey_server.process.children import ChildLimits

MOST_PROCESSES = 32


class ProcessSettings(BaseSettings):
    """Settings of the processes that a server consists of, and their limits."""

    processes: int = Field(
        1,
        ge=1,
        le=MOST_PROCESSES,
        description="Number of server processes that share the port; more than one needs Postgres. The limits "
        "answer_cache_bytes, child_processes, child_requests, database_threads, max_connections and "
        "request_memory_bytes are for all of them together: each process gets an equal share.",
    )
    metrics_port: int | None = Field(
        None,
        ge=1,
        le=65535 - MOST_PROCESSES,
        description="Port at which the first server process also answers /metrics, /healthz and /readyz; the second "
        "process uses the next port, and so on. Absent: these addresses are only at the port of the server, where any "
        "process may answer.",
    )
    child_processes: int | None = Field(
        None,
        ge=2,
        le=64,
        description="Processes in which the server reads uploaded files and computes on stored data; no user "
        "can use all of them at the same time. Absent: one more than the number of processors, but at least 3 and at "
        "most 5.",
    )
    warm_up: bool = Field(
        True,
        description="Compile missing kernels and start the child processes when the server starts. If false, the first "
        "requests that need kernels or child processes wait until these are ready, and each child needs memory "
        "(`child_memory_mb`) for its kernels.",
    )
    child_requests: int = Field(
        32,
        ge=2,
        description="Greatest number of requests that use a child process or wait for one; at most half of them from "
        "one user. Further requests are answered with 503.",
    )
    child_memory_mb: int = Field(1024, ge=64, description="Memory in MiB that a child process may use for a request.")
    child_processor_s: float = Field(
        30.0, ge=1, description="Greatest processor time in seconds of a child process for one request."
    )
    child_wall_s: float = Field(
        120.0, ge=1, description="Greatest duration in seconds of a child process for one request."
    )

    @property
    def child_limits(self) -> ChildLimits:
        """Return the limits of child processes."""
        return ChildLimits(
            children=self.child_processes or min(max(2, os.cpu_count() or 2), 4) + 1,
            requests=self.child_requests,
            memory_mb=self.child_memory_mb,
            processor_s=self.child_processor_s,
            wall_s=self.child_wall_s,
        )

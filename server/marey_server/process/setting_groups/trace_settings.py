"""Settings of traces, and the tracer that they configure."""

from __future__ import annotations

import os
from typing import Literal

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings

from marey_schemas.tracing.export import (
    ENDPOINT_VARIABLE,
    SERVICE_VARIABLE,
    SHARE_VARIABLE,
    Tracer,
    TracesUnusable,
    full_endpoint,
    open_optional_tracer,
    open_tracer,
)

SERVICE = "marey-server"
"""Name under which collectors show the server, unless a variable of OpenTelemetry names another."""
TraceCallers = Literal["nobody", "users", "everybody"]


class TraceSettings(BaseSettings):
    """Settings of the traces that a server sends to a collector."""

    traces_endpoint: str | None = Field(
        None,
        description="Address of a collector that accepts OTLP over HTTP, such as http://127.0.0.1:4318; needs the "
        "extra `traces`. Absent: the address in OTEL_EXPORTER_OTLP_ENDPOINT, or no traces.",
    )
    traces_share: float | None = Field(
        None,
        ge=0,
        le=1,
        description="Sampling rate of the traces that begin in this server, from 0 to 1. Absent: as "
        "OTEL_TRACES_SAMPLER defines it, or 1.",
    )
    traces_callers: TraceCallers = Field(
        "users",
        description="Callers whose header traceparent decides whether, and in which trace, their requests are "
        "recorded: nobody, users (all callers with a valid token), or everybody. Requests without a valid token are "
        "recorded only with everybody.",
    )

    @field_validator("traces_endpoint")
    @classmethod
    def _check_traces_endpoint(cls, endpoint: str | None) -> str | None:
        try:
            return None if endpoint is None else full_endpoint(endpoint)
        except TracesUnusable as error:
            raise ValueError(str(error)) from error

    def open_tracer(self) -> Tracer | None:
        """Return the sender of traces, or None if no collector is configured.

        If traces cannot be sent, for example because the extra `traces` is not installed, the setting `traces_endpoint`
        decides: if it is set, `TracesUnusable` is raised. If only variables of OpenTelemetry are set, which may be
        meant for other programs, the reason is logged.
        """
        if self.traces_endpoint is None:
            return open_optional_tracer(SERVICE, os.environ, share=self.traces_share)
        return open_tracer(SERVICE, os.environ, endpoint=self.traces_endpoint, share=self.traces_share)

    @property
    def worker_trace_variables(self) -> dict[str, str]:
        """The variables by which workers on this machine send their spans to the same collector."""
        own = {ENDPOINT_VARIABLE: self.traces_endpoint, SHARE_VARIABLE: self.traces_share}
        named = {name: text for name, text in os.environ.items() if name.startswith("OTEL_")}
        named.pop(SERVICE_VARIABLE, None)  # the name of the server
        return named | {name: str(value) for name, value in own.items() if value is not None}

"""Traces: their configuration, their headers, and the modules that they load."""

import logging
import subprocess
import sys

import pytest

from marey_schemas.tracing.context import TraceContext
from marey_schemas.tracing.export import TracesUnusable, full_endpoint, open_optional_tracer, open_tracer

ENDPOINT = {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9"}


def test_a_place_in_a_trace_survives_its_header() -> None:
    for sampled in (True, False):
        place = TraceContext(2**127 + 5, 7, sampled)
        assert TraceContext.parse(place.header) == place
    later = TraceContext.parse(f"42-{'a' * 32}-{'b' * 16}-ff-more")
    assert later is not None
    assert later.header == f"00-{'a' * 32}-{'b' * 16}-01"


@pytest.mark.parametrize(
    ("variables", "told"),
    [
        ({"OTEL_TRACES_EXPORTER": "zipkin"}, "zipkin"),
        ({"OTEL_EXPORTER_OTLP_PROTOCOL": "grpc"}, "grpc"),
        ({"OTEL_TRACES_SAMPLER": "jaeger_remote"}, "jaeger_remote"),
        ({"OTEL_TRACES_SAMPLER": "traceidratio", "OTEL_TRACES_SAMPLER_ARG": "nan"}, "from 0 to 1"),
        ({"MAREY_TRACES_SHARE": "half"}, "MAREY_TRACES_SHARE"),
        ({"MAREY_TRACES_ENDPOINT": "127.0.0.1:4318"}, "address of a collector"),
        ({"MAREY_TRACES_ENDPOINT": "http://me:secret@127.0.0.1:4318"}, "no user name"),
    ],
)
def test_a_wrong_variable_is_named_and_stops_no_command(
    variables: dict[str, str], told: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert open_optional_tracer("test", ENDPOINT | variables) is None
    (record,) = caplog.records
    assert told in record.getMessage()
    assert "secret" not in record.getMessage()


def test_without_a_collector_or_if_it_is_switched_off_nothing_is_sent() -> None:
    for variables in ({}, ENDPOINT | {"OTEL_SDK_DISABLED": "true"}, ENDPOINT | {"OTEL_TRACES_EXPORTER": "none"}):
        assert open_tracer("test", variables) is None


def test_an_address_without_a_path_gets_that_for_spans() -> None:
    assert full_endpoint("http://127.0.0.1:4318/") == "http://127.0.0.1:4318/v1/traces"
    assert full_endpoint("https://collector/own/path") == "https://collector/own/path"


def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [*filter(lambda one: one.startswith("opentelemetry.exporter"), sys.modules), "opentelemetry.exporter"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(TracesUnusable, match=r"marey\[traces\]"):
        open_tracer("test", ENDPOINT)


def test_without_a_collector_no_package_of_the_extra_is_loaded() -> None:
    program = (
        "import sys, marey_client.tracing, marey_client.transport, marey_worker.attempt_trace\n"
        "from marey_schemas.tracing.export import open_tracer\n"
        "open_tracer('test', {})\n"
        "sys.exit([name for name in sys.modules if name.startswith(('opentelemetry', 'google', 'requests'))] != [])"
    )
    assert subprocess.run([sys.executable, "-c", program], timeout=60, check=False).returncode == 0


def test_messages_of_the_exporter_are_logged_at_most_once_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    tracer = open_tracer("test", ENDPOINT)
    assert tracer is not None
    tracer.close()
    for number in range(100):
        logging.getLogger("opentelemetry.exporter.any").warning("failure %d", number)
    assert len([one for one in caplog.records if "failure" in one.getMessage()]) <= 1

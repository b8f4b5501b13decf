"""Logs, request ids and metrics."""

import asyncio
import json
import logging

import pytest
from prometheus_client.exposition import generate_latest

from marey_schemas.queue.log_lines import JsonFormatter, TextFormatter
from marey_server.process.observe import Metrics, request_id


def record(message: str, **extra: object) -> logging.LogRecord:
    return logging.getLogger("marey").makeRecord("marey", logging.INFO, "f", 1, message, (), None, extra=extra)


def test_a_log_line_is_one_json_object_whatever_it_says() -> None:
    line = JsonFormatter().format(record('two\nlines "quoted"', request_id="abc", status=200, unknown="x"))
    assert "\n" not in line
    told = json.loads(line)
    assert told["message"] == 'two\nlines "quoted"'
    assert (told["request_id"], told["status"]) == ("abc", 200)
    assert "unknown" not in told


def test_a_line_for_people_ends_with_the_request_id() -> None:
    assert TextFormatter().format(record("hello", request_id="abc")).endswith("hello [abc]")


@pytest.mark.parametrize("given", [None, "", "short", "x" * 200, "with space here", "line\nfeed-feed", "<script>12345"])
def test_an_id_that_is_not_sane_is_replaced(given: str | None) -> None:
    made = request_id(given)
    assert made != given
    assert len(made) == 24


def test_a_sane_id_is_kept() -> None:
    assert request_id("0123-abcd.EF:1_2") == "0123-abcd.EF:1_2"


def test_metrics_of_two_servers_in_one_process_are_their_own() -> None:
    one, two = Metrics(), Metrics()
    one.count_request("GET", "/healthz", 200, 0.1, 5)
    assert b'route="/healthz"' in shown(one)
    assert b'route="/healthz"' not in shown(two)


def shown(metrics: Metrics) -> bytes:
    return asyncio.run(metrics.exposition())[0]


def test_metrics_are_shown_as_the_library_shows_them_all_at_once() -> None:
    metrics = Metrics()
    metrics.count_request("GET", "/healthz", 200, 0.1, 5)
    changing = (b"process_", b"# ", b"marey_events_lag_seconds", b"marey_figures_age_seconds")
    lines = [line for line in generate_latest(metrics.registry).splitlines() if not line.startswith(changing)]
    assert [line for line in shown(metrics).splitlines() if not line.startswith(changing)] == lines


def test_metrics_that_are_asked_for_together_are_rendered_once_more_and_are_new() -> None:
    """Rendering takes long, so many requests for metrics at once must not occupy the event loop."""
    metrics = Metrics()
    rendered: list[int] = []

    async def ask(number: int) -> bytes:
        metrics.imports.labels("stored").inc()
        answer = (await metrics.exposition())[0]
        rendered.append(metrics._renderings)
        assert float(answer.partition(b'marey_imported_files_total{status="stored"} ')[2].split()[0]) > number
        return answer

    async def crowd() -> None:
        first = asyncio.create_task(ask(0))
        await asyncio.sleep(0)
        await asyncio.gather(first, *map(ask, range(1, 50)))

    asyncio.run(crowd())
    assert rendered == [1] + 49 * [2]

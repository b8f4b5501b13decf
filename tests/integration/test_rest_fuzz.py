"""Requests that schemathesis generates from the OpenAPI document, and checks of the server's answers."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from schemathesis.generation import GenerationMode
from tests.support.generated_requests import FuzzedServer, fuzzed_server, generate, operations, probes
from tests.support.tiers import examples

from marey_server.store.database.connections import Database
from marey_server.store.database.schema import upgrade_schema

FEW = 1
"""Requests for each probe in the tier `test`. In the tier `soak`, `test_generated_requests.py` sends many more."""
SEED = 20261121
CALLERS = ("anonymous", "reader", "owner")


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FuzzedServer]:
    """A server with a private project, users and jobs."""
    folder: Path = tmp_path_factory.mktemp("fuzzed")
    url = f"sqlite:///{folder / 'marey.db'}"
    upgrade_schema(url)
    with fuzzed_server(Database(url), folder) as server:
        yield server


def test_requests_are_sent_to_all_published_operations() -> None:
    published = operations()
    unfit = {label for label, operation in published.items() if operation.query or operation.body}
    assert {label for label, mode in probes() if mode is GenerationMode.POSITIVE} == published.keys()
    assert {label for label, mode in probes() if mode is GenerationMode.NEGATIVE} == unfit


@pytest.mark.parametrize(
    ("label", "mode"), [pytest.param(label, mode, id=f"{label} {mode.value}") for label, mode in probes()]
)
def test_every_answer_is_as_published_and_none_is_a_fault_of_ours(
    fuzzed: FuzzedServer, label: str, mode: GenerationMode
) -> None:
    for requests in fuzzed.requests(operations()[label], mode):
        generate(requests, examples(FEW), SEED, lambda case: [fuzzed.send(case, name) for name in CALLERS])

"""The published OpenAPI document against the server, with whatever schemathesis thinks of.

`--tier soak` searches longer.
"""

from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, assume, given, seed, settings
from schemathesis.checks import not_a_server_error
from schemathesis.generation import GenerationMode
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from tests.support.rest_server import Server, running
from tests.support.tiers import examples

from marey_schemas.access import Role
from marey_server.handlers.catalogue import RESOURCES
from marey_server.http.openapi import build_document
from marey_server.http.routes import RouteTable
from marey_server.store.database.connections import Database
from marey_server.store.database.schema import upgrade_schema

CANARY = "canary-91ab"
LONGEST_QUERY = 50_000
"""Of a longer head the server takes no notice but to close the connection."""
CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
]
CONFIGURATION = schemathesis.config.SchemathesisConfig()
DOCUMENT = build_document(RouteTable(None, RESOURCES), version("marey"))


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory):
    """A server with a private project, the names of what is in it, and three callers."""
    folder: Path = tmp_path_factory.mktemp("fuzzed")
    url = f"sqlite:///{folder / 'marey.db'}"
    upgrade_schema(url)
    database = Database(url)
    with running(database, folder, login_tries_per_minute=1_000_000) as server:
        reader = server.make_user("reader")
        callers = {"none": None, "reader": reader, "owner": server.make_project("lab", reader=Role.READER)}
        yield server, callers, furnish(server, callers["owner"])


def furnish(server: Server, token: str) -> dict[str, object]:
    """Things to ask for, by the name of the path's variable."""
    owner = server.client(token)
    hierarchy = {"schema": "marey/skeleton@1", "joints": [{"name": CANARY, "parent": -1, "offset": [0, 1, 0]}]}
    body = {"name": CANARY, "collection": CANARY, "parts": {"hierarchy": hierarchy}}
    made = owner.post("/projects/lab/skeletons", json=body, headers={"Idempotency-Key": "furnish"})
    collections = owner.get("/projects/lab/collections").json()["items"]
    stream = owner.post("/projects/lab/coverage-streams", json={"frame_rate_hz": 60})
    return {
        "project": "lab", "kind": "skeletons", "item": made.json()["id"], "part": "hierarchy", "revision": 1,
        "collection": collections[0]["id"], "user": "reader", "job_kind": "import", "stream": stream.json()["id"],
    }  # fmt: skip


def operations():
    """Every operation of the document."""
    schema = schemathesis.openapi.from_dict(DOCUMENT, config=CONFIGURATION)
    results: Any = schema.get_all_operations()
    return [result.ok() for result in results]


def probes():
    """Every operation with fitting requests, and with unfit ones where there is something to get wrong."""
    for operation in operations():
        yield pytest.param(operation, GenerationMode.POSITIVE, id=f"{operation.label} fitting")
        if operation.query or operation.body:
            yield pytest.param(operation, GenerationMode.NEGATIVE, id=f"{operation.label} unfit")


@pytest.mark.parametrize(("operation", "mode"), list(probes()))
def test_every_answer_is_as_published_and_none_is_a_fault_of_ours(fuzzed, operation, mode):
    server, callers, things = fuzzed
    names = {parameter.name for parameter in operation.path_parameters}
    nothing: dict[str, str] = {}
    for known in (things, nothing):
        chosen = {name: value for name, value in known.items() if name in names}
        strategy = operation.as_strategy(mode, path_parameters=chosen or None)

        @seed(20261121)
        @settings(
            max_examples=examples(4),
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(case=strategy)
        def probe(case):
            assume(len(quote(str(case.query or ""))) < LONGEST_QUERY)
            for name, token in callers.items():
                headers = {"Authorization": f"Bearer {token}"} if token else {}
                answer = case.call(base_url=server.address, headers=headers, timeout=60)
                case.validate_response(answer, checks=CHECKS)
                if name == "none" and CANARY not in str(case.formatted_path):
                    assert CANARY not in answer.text

        probe()

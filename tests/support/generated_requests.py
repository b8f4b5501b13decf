"""Requests that schemathesis generates from the OpenAPI document, for a server with contents and all callers."""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import schemathesis
from hypothesis import HealthCheck, Phase, assume, given, seed, settings
from schemathesis import APIOperation, Case
from schemathesis.checks import not_a_server_error
from schemathesis.generation import GenerationMode
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from tests.support.api_document import api_document, api_routes
from tests.support.furnished_house import CANARY, INVENTED, House, build_house
from tests.support.rest_server import running
from tests.support.tiers import is_soak

from marey_server.handlers.queue.jobs import LONGEST_WAIT_S
from marey_server.store.database.connections import Database

LONGEST_QUERY = 50_000
"""Longest query string to send: if the head of a request is longer, the server closes the connection unanswered."""
CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
]
AnyOperation = APIOperation[Any, Any, Any, Any]
AnyCase = Case[Any]


@dataclass(frozen=True)
class FuzzedServer:
    """Server with users, a project and jobs, and checks of its answers."""

    house: House

    def send(self, case: AnyCase, name: str) -> tuple[int, float]:
        """Send a request as a caller, check the answer, and return its status and how many seconds the server took.

        The time for which the request asked the server to wait for jobs is not included.
        """
        answer = case.call(base_url=self.house.people.address, headers=self._headers(name, case), timeout=120)
        case.validate_response(answer, checks=CHECKS)
        if name == "anonymous" and CANARY not in str(case.formatted_path):
            assert CANARY not in answer.text
        return answer.status_code, answer.elapsed - _requested_wait_s(case)

    def _headers(self, name: str, case: AnyCase) -> dict[str, str]:
        """Return headers with the caller's credential; for a request that signs out, the credential is a new token."""
        token = self.house.tokens[name]
        if case.operation.label.endswith("/logout"):
            wanted = {"name": "fuzz", "scopes": ["read"]}
            made = self.house.people.client(token).post("/tokens", json=wanted)
            token = made.json()["secret"] if made.is_success else INVENTED
        return {"Authorization": f"Bearer {token}"} if token else {}

    def requests(self, operation: AnyOperation, mode: GenerationMode) -> Iterator[Any]:
        """Yield a strategy for requests for existing contents, and one for random ids, if the path contains ids.

        Outside the tier `soak`, invalid requests for random ids are left out: most are refused because of the id.
        """
        names = {parameter.name for parameter in operation.path_parameters}
        chosen = {name: value for name, value in self.house.variables.items() if name in names}
        yield operation.as_strategy(mode, path_parameters=chosen or None)
        if chosen and (mode is GenerationMode.POSITIVE or is_soak()):
            yield operation.as_strategy(mode)


def _requested_wait_s(case: AnyCase) -> float:
    """Return for how many seconds a request asks the server to wait, in its body or in the header `Prefer`."""
    body = case.body if isinstance(case.body, dict) else {}
    waits = [float(found) for found in re.findall(r"wait=(\d{1,4})", str(dict(case.headers or {})))]
    if isinstance(wait_s := body.get("wait_s"), int | float):
        waits.append(wait_s)
    return min(LONGEST_WAIT_S, max(waits, default=0.0))


@contextlib.contextmanager
def fuzzed_server(database: Database, folder: Path) -> Iterator[FuzzedServer]:
    """Run a server with a private project and users of all kinds until the `with` block ends."""
    with running(database, folder, login_tries_per_minute=1_000_000) as server:
        house = build_house(server)
        server.make_user("fred")
        house.variables["user"] = "fred"  # whom the administrator may change without taking somebody's token away
        yield FuzzedServer(house)


@functools.cache
def operations() -> Mapping[str, AnyOperation]:
    """Return every operation of the OpenAPI document by its label, as in `GET /api/v1/projects`."""
    document = _with_plain_arrays(deepcopy(api_document()))
    schema = schemathesis.openapi.from_dict(document, config=schemathesis.config.SchemathesisConfig())
    results: Any = schema.get_all_operations()
    return {operation.label: operation for operation in (result.ok() for result in results)}


def _with_plain_arrays(document: Any) -> Any:
    """Write tuples whose elements have one schema as arrays of a fixed length, which accept the same values.

    In responses, schemathesis 4.32 writes `prefixItems` in the form of JSON Schema draft 7, and then refuses this form.
    """
    if isinstance(document, list):
        return [_with_plain_arrays(one) for one in document]
    if not isinstance(document, dict):
        return document
    schema = {name: _with_plain_arrays(one) for name, one in document.items()}
    elements = schema.get("prefixItems") or [None]
    if isinstance(elements, list) and None not in elements and all(one == elements[0] for one in elements):
        schema["items"] = schema.pop("prefixItems")[0]
    return schema


def probes() -> Iterator[tuple[str, GenerationMode]]:
    """Yield (label of the operation, mode) for valid requests to each operation.

    If the operation has a query or a body, also yield it for invalid requests. The table of routes contains all this:
    building the OpenAPI document takes a second, and each test process names its tests.
    """
    for route in api_routes():
        label = f"{route.operation.method} {route.template}"
        yield label, GenerationMode.POSITIVE
        if (route.operation.query and route.operation.query.model_fields) or route.operation.body:
            yield label, GenerationMode.NEGATIVE


def generate(requests: Any, number: int, of_seed: int, send: Callable[[AnyCase], object]) -> None:
    """Generate `number` requests, and call `send` with each."""

    @seed(of_seed)
    @settings(
        max_examples=number,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=requests)
    def probe(case: AnyCase) -> None:
        assume(len(quote(str(case.query or ""))) < LONGEST_QUERY)
        send(case)

    probe()

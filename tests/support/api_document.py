"""The OpenAPI document of the server, which is built once for all tests of a process."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from typing import Any

from marey_server.handlers.catalogue import RESOURCES
from marey_server.http.openapi import build_document
from marey_server.http.routes import Route, routes_of


@functools.cache
def api_routes() -> tuple[Route, ...]:
    """Return all routes of the server."""
    return tuple(routes_of(RESOURCES))


@functools.cache
def api_document() -> dict[str, Any]:
    """Return the OpenAPI document. All tests of a process use the same object and must not change it."""
    return build_document(api_routes(), "1.2.3")


def document_of(operations: Iterable[str]) -> dict[str, Any]:
    """Return the part of the OpenAPI document that describes some operations, named by their ids."""
    whole, wanted = api_document(), set(operations)
    paths: dict[str, Any] = {}
    for path, entry in whole["paths"].items():
        methods = {name: one for name, one in entry.items() if name == "parameters" or one["operationId"] in wanted}
        if len(methods) > 1:
            paths[path] = methods
    found = {one["operationId"] for entry in paths.values() for name, one in entry.items() if name != "parameters"}
    assert found == wanted, f"the API has no operations {sorted(wanted - found)}"
    components = whole["components"]
    names = {"Problem", *_references(paths)}
    while further := {one for name in names for one in _references(components["schemas"][name])} - names:
        names |= further
    schemas = {name: schema for name, schema in components["schemas"].items() if name in names}
    return whole | {"paths": paths, "components": components | {"schemas": schemas}}


def _references(value: object) -> Iterator[str]:
    """Yield the names of the schemas to which a part of the document refers."""
    if isinstance(value, dict):
        reference = value.get("$ref")
        if isinstance(reference, str) and reference.startswith("#/components/schemas/"):
            yield reference.rpartition("/")[2]
        for one in value.values():
            yield from _references(one)
    elif isinstance(value, list):
        for one in value:
            yield from _references(one)

"""The OpenAPI document, compared with the routes that it describes."""

import base64
import hashlib
import json
import re
from typing import Any, NamedTuple, cast

import pytest
from jsonschema import Draft202012Validator
from pydantic import BaseModel
from tests.support.api_document import api_document, api_routes

from marey_schemas.base import Answer
from marey_schemas.encoding.codecs import MEDIA_TYPES
from marey_schemas.items import ItemCreate
from marey_server.handlers.catalogue import RESOURCES
from marey_server.http.docs_page import POLICY, render_page
from marey_server.http.routes import Route, RouteTable


class Described(NamedTuple):
    """Path, method and description of an operation."""

    path: str
    method: str
    operation: dict[str, Any]


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    """The whole document; only read it."""
    return api_document()


@pytest.fixture(scope="module")
def operations(document: dict[str, Any]) -> list[Described]:
    """All operations of the document."""
    return [
        Described(path, method, operation)
        for path, entry in document["paths"].items()
        for method, operation in entry.items()
        if method != "parameters"
    ]


def test_every_route_is_described_once_and_nothing_else_is(operations: list[Described]) -> None:
    described = {(path, method.upper()) for path, method, _ in operations}
    assert described == {(route.template, route.operation.method) for route in api_routes()}
    names = [operation["operationId"] for _, _, operation in operations]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("route", api_routes(), ids=lambda route: f"{route.operation.method} {route.template}")
def test_an_operation_says_what_it_does_who_may_and_what_can_go_wrong(document: dict[str, Any], route: Route) -> None:
    path, entry = route.template, document["paths"][route.template]
    operation = entry[route.operation.method.lower()]
    assert operation["summary"]
    assert operation["description"].endswith(".")
    (sample,) = operation["x-codeSamples"]
    assert sample["source"].startswith("curl")
    assert not set(re.findall(r"\{(\w+)\}", sample["source"].partition("$MAREY_SERVER")[2]))
    assert operation["x-access"]
    assert "default" in operation["responses"]
    success = [status for status in operation["responses"] if status.startswith("2")]
    assert success
    if operation["x-access"] not in ("anyone",):
        assert {"401", "403", "404"} <= operation["responses"].keys()
    variables = set(re.findall(r"\{(\w+)\}", path))
    assert {parameter["name"] for parameter in entry["parameters"]} == variables


def test_models_are_offered_in_every_form(document: dict[str, Any]) -> None:
    content = document["paths"]["/api/v1/projects/{project}"]["get"]["responses"]["200"]["content"]
    assert set(content) == set(MEDIA_TYPES)
    part = document["paths"]["/api/v1/projects/{project}/{kind}/{item}/parts/{part}"]["get"]["responses"]["200"]
    assert "application/msgpack; arrays=blocks" in part["content"]


def test_preconditions_and_keys_are_parameters(document: dict[str, Any]) -> None:
    patch = document["paths"]["/api/v1/projects/{project}"]["patch"]["parameters"]
    assert {parameter["name"]: parameter["required"] for parameter in patch} == {"If-Match": True}
    post = document["paths"]["/api/v1/projects"]["post"]["parameters"]
    assert [parameter["name"] for parameter in post] == ["Idempotency-Key"]


def test_operations_describe_the_refusals_of_missing_and_of_wrong_preconditions(document: dict[str, Any]) -> None:
    for route in api_routes():
        operation, at = route.operation, f"{route.operation.method} {route.template}"
        statuses = document["paths"][route.template][operation.method.lower()]["responses"].keys()
        assert ("428" in statuses) == (operation.precondition in ("required", "create")), at
        assert ("412" in statuses) == (operation.precondition != "none"), at


def test_every_reference_leads_somewhere(document: dict[str, Any]) -> None:
    references = set(re.findall(r'"#/components/(\w+)/([^"]+)"', json.dumps(document)))
    assert references
    for section, name in references:
        assert name in document["components"][section]


def test_lists_that_can_show_some_fields_are_described_so(document: dict[str, Any]) -> None:
    schema = document["paths"]["/api/v1/projects/{project}/{kind}"]["get"]["responses"]["200"]["content"]
    element = schema["application/json"]["schema"]["properties"]["items"]["items"]["$ref"].rpartition("/")[2]
    assert "required" not in document["components"]["schemas"][element]


def test_the_page_shows_every_operation_and_asks_nobody_else(
    document: dict[str, Any], operations: list[Described]
) -> None:
    page = render_page(document).decode()
    assert page.count("<main>") == page.count("</main>") == 1
    assert page.count("<pre tabindex=0>") == len(document["components"]["schemas"])  # they scroll, also by keys
    for path, _, operation in operations:
        assert path in page
        assert f"id='{operation['operationId']}'" in page
    assert re.findall(r"(?:src|href|action|url\(|import)[=\s'\"]*(?:https?:)?//", page) == []
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() in POLICY
    assert not re.search("localStorage|sessionStorage|cookie\\.|innerHTML", script)
    assert "id='problem-precondition-required'" in page
    names = re.findall(r" id='?([\w-]+)", page)
    assert len(set(names)) == len(names)


def test_no_two_resources_share_an_address() -> None:
    with pytest.raises(ValueError, match="two resources have the path"):
        RouteTable(cast(Any, None), [*RESOURCES, RESOURCES[0]])


def test_every_body_and_answer_has_a_schema(operations: list[Described]) -> None:
    """Generators of clients leave out operations with content whose schema is missing."""
    contents = [
        (path, media)
        for path, _, operation in operations
        for one in (operation.get("requestBody", {}), *operation["responses"].values())
        for media, content in one.get("content", {}).items()
        if not content.get("schema")
    ]
    assert contents == []


def test_members_have_no_titles_that_would_name_the_classes_of_clients_twice(document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]
    titled = {
        (name, member, inner["title"])
        for name, schema in schemas.items()
        for member, inner in schema.get("properties", {}).items()
        if "title" in inner
    }
    assert titled == {
        ("BatchCompletion", "result", "result by name"),
        ("Item", "facets", "facets by name"),
        ("SomeItem", "facets", "facets by name"),
    }


def test_defaults_are_documented_but_not_sent_by_generated_clients(document: dict[str, Any]) -> None:
    """A token whose request names no time ends with the token that creates it; the default as a number is refused."""
    expiry = document["components"]["schemas"]["TokenCreate"]["properties"]["expires_in_s"]
    assert "default" not in expiry
    assert expiry["description"].endswith("Default: 7776000.")
    motion = document["components"]["schemas"]["MotionDocument"]["properties"]["schema"]
    assert motion["default"] == motion["const"] == "marey/motion@1"


def test_every_example_fits_its_schema(document: dict[str, Any], operations: list[Described]) -> None:
    shown = 0
    for path, method, operation in operations:
        parameters = [*document["paths"][path]["parameters"], *operation["parameters"]]
        holders = (operation.get("requestBody", {}), *operation["responses"].values())
        media = [
            holder["content"]["application/json"]
            for holder in holders
            if "application/json" in holder.get("content", {})
        ]
        for described in (*parameters, *media):
            schema = {**described["schema"], "components": document["components"]}
            faults = [fault.message for fault in Draft202012Validator(schema).iter_errors(described["example"])]
            assert faults == [], f"{method} {path}"
            shown += 1
    assert shown > 4 * len(operations)


def test_the_example_of_a_command_can_be_sent(document: dict[str, Any]) -> None:
    create = document["paths"]["/api/v1/projects/{project}/{kind}"]["post"]
    assert ItemCreate.model_validate(create["requestBody"]["content"]["application/json"]["example"]).name == "walk"
    command = create["x-codeSamples"][0]["source"]
    assert command.startswith('curl -X POST -H "Authorization: Bearer $MAREY_TOKEN"')
    assert command.endswith('"$MAREY_SERVER/api/v1/projects/lab/skeletons"')


def test_the_page_shows_names_between_backticks_as_code(document: dict[str, Any]) -> None:
    page = render_page(document).decode()
    summary = "Withdraw an open invitation, named by its <code>id</code>"
    assert f"<code>/api/v1/invitations/{{invitation}}</code> {summary}" in page
    outside = re.sub("<(pre|script)[ >].*?</(pre|script)>", "", page, flags=re.DOTALL)
    assert "`" not in outside


def test_models_of_answers_ignore_the_fields_that_newer_servers_add() -> None:
    answers = {route.operation.answer for route in api_routes()}
    models = [one for one in answers if isinstance(one, type) and issubclass(one, BaseModel)]
    assert len(models) > 50
    assert [one.__name__ for one in models if not issubclass(one, Answer)] == []

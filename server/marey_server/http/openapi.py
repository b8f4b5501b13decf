"""OpenAPI 3.1 document, generated from the declarations of the handlers."""

from __future__ import annotations

import re
from collections.abc import Iterable
from http import HTTPStatus
from typing import cast

from pydantic import BaseModel

from marey_schemas.encoding.codecs import MEDIA_TYPES
from marey_schemas.formats import OCTETS
from marey_schemas.kinds import PARTS, Kind
from marey_schemas.names import DIGEST_PATTERN
from marey_schemas.problems import MEDIA_TYPE as PROBLEM_TYPE
from marey_server.http.declarations import Access, Bytes, Document, Files, Operation, RequestBody, conditions_of
from marey_server.http.examples import curl_command, example_of
from marey_server.http.multipart import FORM
from marey_server.http.negotiation import DOCUMENT_FORMS
from marey_server.http.openapi_models import REF, ApiModels, Schema, bytes_schema, form_schema, without_null
from marey_server.http.routes import Route

_NAME = {"type": "string", "minLength": 1}
_PART_NAMES = sorted({part for parts in PARTS.values() for part in parts})
PATH_VARIABLES: dict[str, tuple[str, Schema]] = {
    "project": ("Name of the project.", _NAME),
    "user": ("Name of the user.", _NAME),
    "kind": ("Kind of the items, in the plural.", {"type": "string", "enum": [kind.plural for kind in Kind]}),
    "item": ("Id of the item.", _NAME),
    "collection": ("Id of the folder.", _NAME),
    "part": ("Name of the part.", {"type": "string", "enum": _PART_NAMES}),
    "figure": ("Name of the figure.", {"type": "string", "pattern": "^[a-z0-9][a-z0-9_-]{0,63}$"}),
    "revision": ("Number of the revision.", {"type": "integer", "minimum": 1, "maximum": 999_999_999}),
    "dataset": ("Name of the dataset.", _NAME),
    "ref": ("Name of the branch or tag.", _NAME),
    "script": ("Name of the script.", _NAME),
    "schedule": ("Name of the schedule.", _NAME),
    "proposal": ("Number of the proposal.", {"type": "integer", "minimum": 1, "maximum": 999_999_999}),
    "identity": ("Id of the identity.", _NAME),
    "sign_in": ("Id of the sign-in.", _NAME),
    "invitation": ("Id or prefix of the invitation.", _NAME),
    "webhook": ("Id of the webhook.", _NAME),
    "delivery": ("Id of the delivery.", _NAME),
    "version": ("Branch, tag or commit; with ~n at its end, the version n commits earlier.", _NAME),
    "token": ("Id of the token.", _NAME),
    "upload": ("Id of the upload.", _NAME),
    "asset": ("Name of the file.", _NAME),
    "digest": ("Digest of the blob.", {"type": "string", "pattern": DIGEST_PATTERN}),
    "job": ("Id of the job.", _NAME),
    "job_kind": ("Name of the kind of job.", _NAME),
    "stream": ("Id of the coverage stream.", _NAME),
    "participant": ("Id of the participant of a study.", _NAME),
    "trial": ("Number of the trial.", {"type": "integer", "minimum": 0, "maximum": 999_999_999}),
    "clip": ("Number of a motion of the study, from 0.", {"type": "integer", "minimum": 0, "maximum": 999_999_999}),
    "file": ("Name of a file in the result of the job.", {"type": "string", "pattern": "^[a-z0-9_]{1,64}$"}),
    "fence": ("Fence of the attempt.", {"type": "integer", "minimum": 0, "maximum": 999_999_999}),
}  # fmt: skip
_OFFSET = {"type": "integer", "minimum": 0, "maximum": 10**12 - 1}
_STATE = {"type": "string", "pattern": r'^(\*|"[0-9]{1,9}\.[a-z-]+")$'}
_HEADER_SCHEMAS: dict[str, Schema] = {
    "If-Match": _STATE,
    "If-None-Match": {"type": "string", "pattern": r"^\*$"},
    "Idempotency-Key": {"type": "string", "pattern": "^[!-~]{1,255}$"},
    "Upload-Offset": _OFFSET,
    "Last-Event-ID": _OFFSET,
}
_ALWAYS_NEEDED = {"Upload-Offset"}
_HEADERS = {
    "If-Match": 'ETag of the version that you read, such as "7.json"; * for any version.',
    "If-None-Match": "*: create the resource only if it does not exist.",
    "Prefer": "wait=20: answer when the job has ended, but after at most 20 seconds.",
    "Range": "bytes=0-1023: return only these bytes.",
    "If-Range": "Return the range only if the resource still has this ETag; otherwise return all bytes.",
    "Last-Event-ID": "Number of the last event that you received, to continue a stream after it.",
    "Upload-Offset": "Number of bytes that the server has already received; any other number is refused.",
    "X-Request-Id": "Name of the request in the server's log; absent: the server chooses one.",
    "Idempotency-Key": "Text that you choose. For seven days, the same request with the same text gets the same "
    "answer.",
}
_TOKEN_NEEDED: list[Schema] = [{"bearer": []}]
_TOKEN_OPTIONAL: list[Schema] = [{}, {"bearer": []}]


def build_document(routes: Iterable[Route], version: str) -> Schema:
    """Return the OpenAPI document that describes the operations of `routes`."""
    routes = list(routes)
    models = ApiModels(route.operation for route in routes)
    paths: dict[str, Schema] = {}
    for route in routes:
        entry = paths.setdefault(route.template, {"parameters": [_path_parameter(name) for name in route.variables]})
        entry[route.operation.method.lower()] = _operation(route, models)
    _add_examples(paths, models.components)
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "Marey",
            "version": version,
            "summary": "Motion data and model management.",
            "description": "Documents travel as JSON, MessagePack or BSON; errors are problem documents (RFC 9457).",
            "license": {"name": "MIT", "identifier": "MIT"},
        },
        "servers": [{"url": "/"}],
        "tags": [{"name": tag} for tag in dict.fromkeys(route.resource.tag for route in routes)],
        "paths": paths,
        "components": {
            "schemas": models.components,
            "securitySchemes": {"bearer": {"type": "http", "scheme": "bearer", "description": "A token of Marey."}},
            "responses": {"Problem": _problem_response(), "ProblemPage": _problem_response("text/html")},
        },
    }


def _operation(route: Route, models: ApiModels) -> Schema:
    operation = route.operation
    guests = operation.access is Access.ANYONE or (operation.access is Access.READER and operation.public)
    entry: Schema = {
        "operationId": f"{operation.method.lower()}_{_snake(route.resource.__name__)}",
        "summary": operation.summary,
        "tags": [route.resource.tag],
        "parameters": [*_query_parameters(operation), *_header_parameters(operation)],
        "responses": _responses(operation, models),
        "security": _TOKEN_OPTIONAL if guests else _TOKEN_NEEDED,
        "x-access": operation.access.value,
    }
    if operation.scope is not None:
        entry["x-scope"] = operation.scope
    entry["description"] = "\n\n".join(filter(None, (operation.description, conditions_of(operation))))
    if operation.body is not None:
        entry["requestBody"] = _request_body(operation.body, models)
    return entry


def _add_examples(paths: dict[str, Schema], components: dict[str, Schema]) -> None:
    """Add examples to the paths of an OpenAPI document.

    Each parameter, and each body and answer in JSON, gets an example. Each operation gets a curl command that sends
    these examples.
    """
    for path, entry in paths.items():
        shared = entry["parameters"]
        for method, operation in entry.items():
            if method == "parameters":
                continue
            for parameter in (*shared, *operation["parameters"]):
                parameter.setdefault("example", example_of(parameter["schema"], components, parameter["name"]))
            for holder in (operation.get("requestBody", {}), *operation["responses"].values()):
                media = holder.get("content", {}).get("application/json")
                if media is not None:
                    media["example"] = example_of(media["schema"], components)
            source = curl_command(method.upper(), path, operation, shared)
            operation["x-codeSamples"] = [{"lang": "Shell", "label": "curl", "source": source}]


def _snake(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


def _path_parameter(name: str) -> Schema:
    description, schema = PATH_VARIABLES[name]
    return {"name": name, "in": "path", "required": True, "description": description, "schema": schema}


def _query_parameters(operation: Operation) -> list[Schema]:
    if operation.query is None:
        return []
    schema = operation.query.model_json_schema(by_alias=True, ref_template=REF)
    parameters = []
    for name, found in schema.get("properties", {}).items():
        shown = without_null(found)
        description = shown.pop("description", "")
        parameter = {"name": name, "in": "query", "required": name in schema.get("required", ()), "schema": shown}
        if description:
            parameter["description"] = description
        if shown.get("type") == "array":
            parameter |= {"style": "form", "explode": False}
        parameters.append(parameter)
    return parameters


def _header_parameters(operation: Operation) -> list[Schema]:
    names = []
    if operation.precondition != "none":
        names.append("If-Match")
    if operation.may_create:
        names.append("If-None-Match")
    if operation.idempotency == "key":
        names.append("Idempotency-Key")
    needed = _ALWAYS_NEEDED | ({"If-Match"} if operation.precondition == "required" else set())
    return [
        {
            "name": name, "in": "header", "required": name in needed, "description": _HEADERS[name],
            "schema": _HEADER_SCHEMAS.get(name, {"type": "string"}),
        }
        for name in (*names, *operation.headers)
    ]  # fmt: skip


def _request_body(body: RequestBody, models: ApiModels) -> Schema:
    content: Schema = {}
    if body.content is Bytes:
        content[OCTETS] = {"schema": bytes_schema(OCTETS)}
    elif body.content is Files:
        assert body.fields is not None
        content[FORM] = {"schema": form_schema(body.fields)}
    else:
        schema = models.document() if body.content is Document else models.reading(cast(type[BaseModel], body.content))
        content |= {name: {"schema": schema} for name in MEDIA_TYPES}
    if body.alternative is not None:
        content |= {name: {"schema": models.reading(body.alternative)} for name in MEDIA_TYPES}
    return {"required": body.required, "content": content}


def _responses(operation: Operation, models: ApiModels) -> Schema:
    success: Schema = {"description": HTTPStatus(operation.status).phrase}
    if operation.answer is not None:
        success["content"] = _answer_content(operation, models)
    if operation.etag:
        success["headers"] = {
            "ETag": {
                "description": "Version of the resource and media type of the answer.",
                "schema": {"type": "string"},
            }
        }
    problem = {"$ref": f"#/components/responses/{'ProblemPage' if operation.for_browsers else 'Problem'}"}
    found: Schema = {str(operation.status): success}
    if operation.etag and operation.method == "GET":
        found["304"] = {"description": "The copy that you have is current."}
    if operation.shows_project:
        found["204"] = {"description": "The change was made, but is not shown, because the token lacks the scope read."}
    for status, model in operation.also:
        found[str(status)] = {"description": HTTPStatus(status).phrase}
        if model is not None:
            schema = models.writing(model)
            found[str(status)]["content"] = {name: {"schema": schema} for name in MEDIA_TYPES}
        elif status >= 400:
            found[str(status)] = problem
    for status in _refusals(operation):
        found.setdefault(str(status), problem)
    found["default"] = problem
    return found


def _answer_content(operation: Operation, models: ApiModels) -> Schema:
    answer = operation.answer
    if answer is Bytes:
        return {name: {"schema": bytes_schema(name)} for name in operation.answer_types or (OCTETS,)}
    if answer is Document:
        packed = bytes_schema(OCTETS)
        return {str(form): {"schema": models.document() if form.form == "json" else packed} for form in DOCUMENT_FORMS}
    assert answer is not None
    assert issubclass(answer, BaseModel)
    schema = models.writing(answer)
    if operation.paged:
        selectable = operation.query is not None and "fields" in operation.query.model_fields
        schema = _page_schema(models.partial(answer) if selectable else schema)
    streams: Schema = {"text/event-stream": {"schema": bytes_schema("text/event-stream")}} if operation.stream else {}
    return {name: {"schema": schema} for name in operation.answer_types or MEDIA_TYPES} | streams


def _page_schema(element: Schema) -> Schema:
    return {
        "type": "object",
        "properties": {
            "items": {"type": "array", "items": element},
            "next_cursor": {
                "type": ["string", "null"],
                "description": "Value of the parameter `cursor` for the next page.",
            },
            "count": {"type": ["integer", "null"], "description": "Length of the whole list; only with count=exact."},
        },
        "required": ["items", "next_cursor", "count"],
    }


def _refusals(operation: Operation) -> list[int]:
    found = [400, 406]
    if operation.access is not Access.ANYONE:
        found += [401, 403, 404]
    if operation.precondition != "none":
        found += [412]
    if operation.precondition in ("required", "create"):
        found += [428]
    if operation.body is not None:
        found += [413, 415, 422]
    if operation.method != "GET":
        found += [409]
    return sorted(found)


def _problem_response(*others: str) -> Schema:
    """Return the OpenAPI response for all errors; errors can also have the media types in `others`, such as HTML."""
    return {
        "description": "Reason why the request was refused.",
        "headers": {"X-Request-Id": {"description": "Quote it when asking for help.", "schema": {"type": "string"}}},
        "content": {
            PROBLEM_TYPE: {"schema": {"$ref": REF.format(model="Problem")}},
            **{name: {"schema": bytes_schema(name)} for name in others},
        },
    }

"""Examples of requests and answers, made from their schemas.

If a schema has an example, this is used. Otherwise, the example of a text is chosen by the name of its member, and the
example of any other value is the simplest value that the schema allows.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any
from urllib.parse import quote, urlencode

from marey_server.http.multipart import FORM

Schema = Mapping[str, Any]

_DEEPEST = 6
_DIGEST = "sha256:9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"
_TEXTS = (
    "walk", "lab", "clip_01k8example", "raw/day-1", _DIGEST, _DIGEST[7:], "motion", "clips", "2026-11-29", "main",
    "mean_speed", "user_01k8example", "3b18e512dba79e4c8300dd08aeb37f8e728b8dad",
    "0123456789abcdef0123456789abcdef", "worker-1", "5 4 * * *", "UTC", "1:30",
    "marey/document@1", '"7.json"', "v1.0", "job.failed", "https://example.org/hook", "python walk.py", "*", "a" * 43,
)  # fmt: skip
"""Texts that are tried, in this order, if the text in `_BY_NAME` (by default `text`) does not fit the schema."""
_BY_NAME = {
    "project": "lab", "user": "ada", "name": "walk", "kind": "clips", "part": "motion", "item": "clip_01k8example",
    "job": "job_01k8example", "skeleton": "skeleton_01k8example", "clip": "clip_01k8example", "collection": "raw",
    "path": "raw/walk", "tags": "run", "title": "Walks of the lab", "description": "Walks at three speeds.",
    "message": "First takes", "digest": _DIGEST, "blob": _DIGEST, "ref": "main", "branch": "main", "dataset": "walks",
    "version": "main", "cursor": "eyJpZCI6MX0", "password": "correct horse battery staple", "author": "ada",
    "format": "bvh", "frames": "0:100", "joints": "Hips,LeftFoot", "url": "https://example.org/hook", "unit": "cm",
    "subject": "performer-1", "if-match": '"7.json"', "idempotency-key": "import-2026-11-29", "prefer": "wait=20",
    "item_name": "walk",
    "fields": "id,name", "sort": "name", "q": "walk", "schedule": "nightly", "script": "train", "figure": "speeds",
}  # fmt: skip
"""Example texts for members and parameters, by name."""
_DOCUMENTS = {
    "hierarchy": {"schema": "marey/skeleton@1", "joints": [{"name": "Hips", "parent": -1, "offset": [0, 0.9, 0]}]}
}
_FORMATS = {
    "date-time": "2026-11-29T09:30:00Z", "date": "2026-11-29", "uri": "https://example.org/hook", "binary": "(bytes)",
}  # fmt: skip


def example_of(schema: Schema, components: Mapping[str, Schema], name: str = "", depth: int = 0) -> Any:
    """Return an example of a value that a schema allows.

    `components` contains the schemas to which `$ref` refers, by name. `name` is the name of the member or parameter.
    """
    if "$ref" in schema:
        schema = {**components[schema["$ref"].rpartition("/")[2]], **schema}
    for given in (schema.get("examples", ()), schema.get("enum", ())):
        if given:
            return given[0]
    if "const" in schema:
        return schema["const"]
    if parts := schema.get("allOf"):
        return example_of(parts[0], components, name, depth)
    if choices := schema.get("anyOf") or schema.get("oneOf"):
        return example_of(_first(choices), components, name, depth)
    kinds = schema.get("type", "object" if "properties" in schema else "any")
    kind = kinds[0] if isinstance(kinds, list) else kinds
    if kind == "object":
        return _object(schema, components, name, depth)
    if kind == "array":
        return _list(schema, components, name, depth)
    if kind == "string":
        return _text(schema, name)
    if kind in ("integer", "number"):
        return _number(schema, kind)
    return {"boolean": True, "null": None}.get(kind, {})


def _first(choices: list[Schema]) -> Schema:
    return next(choice for choice in choices if choice.get("type") != "null")


def _object(schema: Schema, components: Mapping[str, Schema], name: str, depth: int) -> dict[str, Any]:
    members: Mapping[str, Schema] = schema.get("properties", {})
    required = schema.get("required", ())
    shown = [member for member in members if member in required]
    if not shown and members and depth == 0:
        shown = [next(iter(members))]  # a change of nothing is refused
    made = {member: example_of(members[member], components, member, depth + 1) for member in shown}
    if not members and schema.get("minProperties", 0):
        others = next(iter(schema.get("patternProperties", {}).values()), schema.get("additionalProperties"))
        if name == "parts":
            return dict(_DOCUMENTS)
        made["walk"] = example_of(others, components, name, depth + 1) if isinstance(others, Mapping) else {}
    return made


def _list(schema: Schema, components: Mapping[str, Schema], name: str, depth: int) -> list[Any]:
    if places := schema.get("prefixItems"):
        return [example_of(one, components, name, depth + 1) for one in places]
    least = schema.get("minItems", 0)
    if "items" not in schema or (depth > _DEEPEST and not least):
        return []
    count = max(least, min(1, schema.get("maxItems", 1)))
    return [example_of(schema["items"], components, name.removesuffix("s"), depth + 1)] * count


def _text(schema: Schema, name: str) -> str:
    if schema.get("format") in _FORMATS:
        return _FORMATS[schema["format"]]
    pattern = schema.get("pattern", "")
    texts = (_BY_NAME.get(name.lower(), "text"), *_TEXTS)
    fitting = (
        text
        for text in texts
        if schema.get("minLength", 0) <= len(text) <= schema.get("maxLength", len(text)) and re.search(pattern, text)
    )
    return next(fitting, texts[0])


def _number(schema: Schema, kind: str) -> float:
    for low, step in (("minimum", 0.0), ("exclusiveMinimum", 1.0)):
        if low in schema and schema[low] + step >= 1:
            return int(schema[low] + step) if kind == "integer" else float(schema[low] + step)
    highest = schema.get("maximum", schema.get("exclusiveMaximum", 2))
    if highest >= 2:
        return 1 if kind == "integer" else 1.0
    return 0 if kind == "integer" else highest / 2


def curl_command(method: str, path: str, operation: Schema, shared: list[dict[str, Any]]) -> str:
    """Return a curl command that sends the example of a request.

    `operation` is the OpenAPI operation with its examples; `shared` are the OpenAPI parameters of the path.
    """
    for parameter in shared:
        path = path.replace(f"{{{parameter['name']}}}", quote(str(parameter["example"]), safe=""))
    needed = [one for one in operation["parameters"] if one["required"]]
    query = urlencode({one["name"]: one["example"] for one in needed if one["in"] == "query"})
    words = [f"curl -X {method}"] if method != "GET" else ["curl"]
    if operation["security"] and operation["security"][0]:
        words.append('-H "Authorization: Bearer $MAREY_TOKEN"')
    words += [f"-H '{one['name']}: {one['example']}'" for one in needed if one["in"] == "header"]
    content = operation.get("requestBody", {}).get("content", {})
    if FORM in content:
        words.append("-F files=@walk.bvh")
    elif "application/octet-stream" in content:
        words.append("--data-binary @walk.bvh")
    elif "application/json" in content:
        body = json.dumps(content["application/json"]["example"], ensure_ascii=False).replace("'", "'\\''")
        words += ["-H 'Content-Type: application/json'", f"-d '{body}'"]
    return " ".join([*words, f'"$MAREY_SERVER{path}{"?" if query else ""}{query}"'])

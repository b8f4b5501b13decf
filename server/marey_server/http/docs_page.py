"""Documentation page of the API: the OpenAPI document as one HTML page without scripts or external resources."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from markupsafe import escape

from marey_server import errors

Schema = dict[str, Any]

_STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #8882; --mark: #2563eb; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: 0 } h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line) }
code, pre { font: 13px/1.45 ui-monospace, monospace } pre { background: var(--soft); padding: .6rem; overflow: auto }
details { border: 1px solid var(--line); border-radius: 6px; margin: .4rem 0 }
summary { cursor: pointer; padding: .35rem .7rem } details > div { padding: 0 .9rem .6rem }
.method { display: inline-block; min-width: 4.2rem; font-weight: 700; color: var(--mark) }
.access { float: right; opacity: .7 } table { border-collapse: collapse; width: 100% }
td, th { text-align: left; vertical-align: top; padding: .2rem .6rem .2rem 0; border-bottom: 1px solid var(--soft) }
nav a { margin-right: .8rem }
"""


def render_page(document: Schema) -> bytes:
    """Return the HTML page for an OpenAPI document."""
    return "".join(_page(document)).encode()


def _page(document: Schema) -> Iterator[str]:
    info = document["info"]
    yield "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
    yield f"<title>{escape(info['title'])} API</title><style>{_STYLE}</style>"
    yield f"<h1>{escape(info['title'])} API</h1><p>Version {escape(info['version'])}. {escape(info['description'])}"
    yield " Programs read <a href='openapi.json'>openapi.json</a>.</p><nav>"
    for tag in document["tags"]:
        yield f"<a href='#{_anchor(tag['name'])}'>{escape(tag['name'])}</a>"
    yield "<a href='#models'>Models</a><a href='#problems'>Problems</a></nav>"
    for tag in document["tags"]:
        yield f"<h2 id='{_anchor(tag['name'])}'>{escape(tag['name'])}</h2>"
        yield from _operations(document, tag["name"])
    yield "<h2 id=models>Models</h2>"
    for name, schema in sorted(document["components"]["schemas"].items()):
        yield f"<details id='model-{escape(name)}'><summary><code>{escape(name)}</code> "
        yield f"{escape(_first_line(schema.get('description', '')))}</summary><div>"
        yield f"<pre>{escape(json.dumps(schema, indent=2, ensure_ascii=False))}</pre></div></details>"
    yield "<h2 id=problems>Problems</h2><table><tr><th>Status<th>Code<th>Meaning"
    yield from _problems()
    yield "</table></html>"


def _operations(document: Schema, tag: str) -> Iterator[str]:
    for path, entry in document["paths"].items():
        for method, operation in entry.items():
            if method != "parameters" and tag in operation["tags"]:
                yield from _operation(path, method, operation, entry["parameters"])


def _operation(path: str, method: str, operation: Schema, shared: list[Schema]) -> Iterator[str]:
    yield f"<details id='{escape(operation['operationId'])}'><summary><span class=method>{method.upper()}</span>"
    yield f"<code>{escape(path)}</code> {escape(operation['summary'])}"
    yield f"<span class=access>{escape(operation['x-access'].replace('_', ' '))}</span></summary><div>"
    yield f"<p>{escape(operation.get('description', ''))}</p>"
    parameters = [*shared, *operation["parameters"]]
    if parameters:
        yield "<table><tr><th>Parameter<th>In<th>Type<th>Meaning"
        for parameter in parameters:
            needed = " (needed)" if parameter["required"] and parameter["in"] != "path" else ""
            yield f"<tr><td><code>{escape(parameter['name'])}</code>{needed}<td>{parameter['in']}"
            yield f"<td>{_type(parameter['schema'])}<td>{escape(parameter.get('description', ''))}"
        yield "</table>"
    if "requestBody" in operation:
        yield f"<p>Body: {_content(operation['requestBody']['content'])}</p>"
    for status, response in operation["responses"].items():
        if "content" in response:
            yield f"<p>{status}: {_content(response['content'])}</p>"
    yield "</div></details>"


def _content(content: Schema) -> str:
    shown = "; ".join(f"<code>{escape(name)}</code>" for name in content)
    types = dict.fromkeys(_type(media["schema"]) for media in content.values() if "schema" in media)
    return f"{' or '.join(types)} as {shown}" if types else shown


def _type(schema: Schema) -> str:
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"<a href='#model-{escape(name)}'>{escape(name)}</a>"
    if choices := schema.get("oneOf") or schema.get("anyOf"):
        return " or ".join(map(_type, choices))
    if "enum" in schema:
        return ", ".join(f"<code>{escape(str(value))}</code>" for value in schema["enum"])
    if schema.get("type") == "array":
        return f"list of {_type(schema.get('items', {}))}"
    if "items" in schema.get("properties", {}):
        return f"page of {_type(schema['properties']['items']['items'])}"
    return escape(str(schema.get("type", "anything")))


def _problems() -> Iterator[str]:
    known: list[type[errors.ApiProblem]] = [
        errors.ApiProblem,
        *sorted(_subclasses(errors.ApiProblem), key=lambda error: (error.status, error.code)),
    ]
    for error in known:
        code, title = escape(error.code), escape(_first_line(error.__doc__ or ""))
        yield f"<tr id='problem-{code}'><td>{error.status}<td><code>{code}</code><td>{title}"


def _subclasses(base: type[errors.ApiProblem]) -> Iterator[type[errors.ApiProblem]]:
    for found in base.__subclasses__():
        yield found
        yield from _subclasses(found)


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0]


def _anchor(name: str) -> str:
    return name.lower().replace(" ", "-")

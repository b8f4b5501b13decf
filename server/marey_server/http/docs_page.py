"""Documentation page of the API: the OpenAPI document as one HTML page without external resources.

A script adds forms that send requests with a token; the token is kept only in the memory of the page. The page can be
read without the script, too.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from markupsafe import escape

from marey_server import errors

Schema = dict[str, Any]

_STYLE, _SCRIPT = (Path(__file__).with_suffix(f".{kind}").read_text("utf-8") for kind in ("css", "js"))
_DIGEST = base64.b64encode(hashlib.sha256(_SCRIPT.encode()).digest()).decode()
POLICY = (
    f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{_DIGEST}'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of the page: only its own script runs, and it connects to this server only."""


def render_page(document: Schema) -> bytes:
    """Return the HTML page for an OpenAPI document."""
    return "".join(_page(document)).encode()


def _page(document: Schema) -> Iterator[str]:
    info = document["info"]
    yield "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
    yield f"<title>{escape(info['title'])} API</title><style>{_STYLE}</style>"
    yield f"<main><h1>{escape(info['title'])} API</h1>"
    yield f"<p>Version {escape(info['version'])}. {escape(info['description'])}"
    yield " Programs read <a href='openapi.json'>openapi.json</a>.</p>"
    yield "<div class=token><label>Token for requests sent from this page; reloading the page forgets it"
    yield "<input id=token type=password autocomplete=off placeholder='marey_…'></label></div><nav>"
    for tag in document["tags"]:
        yield f"<a href='#{_anchor(tag['name'])}'>{escape(tag['name'])}</a>"
    yield "<a href='#schemas'>Schemas</a><a href='#problems'>Problems</a></nav>"
    for tag in document["tags"]:
        yield f"<h2 id='{_anchor(tag['name'])}'>{escape(tag['name'])}</h2>"
        yield from _operations(document, tag["name"])
    yield "<h2 id=schemas>Schemas</h2>"
    for name, schema in sorted(document["components"]["schemas"].items()):
        yield f"<details id='model-{escape(name)}'><summary><code>{escape(name)}</code> "
        yield f"{_with_code(_first_line(schema.get('description', '')))}</summary><div>"
        shown = escape(json.dumps(schema, indent=2, ensure_ascii=False))
        yield f"<pre tabindex=0>{shown}</pre></div></details>"  # long ones scroll, also by keys
    yield "<h2 id=problems>Problems</h2><table><tr class=head><th>Status<th>Code<th>Meaning"
    yield from _problems()
    yield f"</table></main><script>{_SCRIPT}</script></html>"


def _operations(document: Schema, tag: str) -> Iterator[str]:
    for path, entry in document["paths"].items():
        for method, operation in entry.items():
            if method != "parameters" and tag in operation["tags"]:
                yield from _operation(path, method, operation, entry["parameters"])


def _operation(path: str, method: str, operation: Schema, shared: list[Schema]) -> Iterator[str]:
    place = f"data-method={method.upper()} data-path='{escape(path)}'"
    yield f"<details id='{escape(operation['operationId'])}' {place}>"
    yield f"<summary><span class='method {method}'>{method.upper()}</span>"
    yield f"<code>{escape(path)}</code> {_with_code(operation['summary'])}"
    yield f"<span class=access>{escape(operation['x-access'].replace('_', ' '))}</span></summary><div>"
    for paragraph in operation["description"].split("\n\n"):
        yield f"<p>{_with_code(paragraph)}</p>"
    parameters = [*shared, *operation["parameters"]]
    if parameters:
        yield "<table><tr class=head><th>Parameter<th>In<th>Type<th>Meaning"
        for parameter in parameters:
            needed = " (needed)" if parameter["required"] and parameter["in"] != "path" else ""
            yield f"<tr data-name='{escape(parameter['name'])}' data-place={parameter['in']}"
            yield f" data-example='{escape(parameter['example'])}'{' data-required' if parameter['required'] else ''}>"
            yield f"<td><code>{escape(parameter['name'])}</code>{needed}<td>{parameter['in']}"
            yield f"<td>{_type(parameter['schema'])}<td>{_with_code(parameter.get('description', ''))}"
        yield "</table>"
    if "requestBody" in operation:
        yield from _body(operation["requestBody"]["content"])
    for status, response in operation["responses"].items():
        if "content" in response:
            yield f"<p>{status}: {_content(response['content'])}</p>"
    yield from (f"<pre>{escape(sample['source'])}</pre>" for sample in operation["x-codeSamples"])
    yield "</div></details>"


def _with_code(text: str) -> str:
    """Return a text as HTML; text between backquotes becomes code."""
    return re.sub("`([^`]*)`", r"<code>\1</code>", str(escape(text)))


def _body(content: Schema) -> Iterator[str]:
    yield f"<p>Body: {_content(content)}</p>"
    media_type = next(iter(content))
    example = content[media_type].get("example")
    shown = "" if example is None else escape(json.dumps(example, indent=2, ensure_ascii=False))
    yield f"<pre data-body='{media_type}'{'' if shown else ' hidden'}>{shown}</pre>"


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
    named: set[str] = set()
    for error in known:
        code, title = escape(error.code), _with_code(_first_line(error.__doc__ or ""))
        place = "" if code in named else f" id='problem-{code}'"
        named.add(code)
        yield f"<tr{place}><td>{error.status}<td><code>{code}</code><td>{title}"


def _subclasses(base: type[errors.ApiProblem]) -> Iterator[type[errors.ApiProblem]]:
    for found in base.__subclasses__():
        yield found
        yield from _subclasses(found)


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0]


def _anchor(name: str) -> str:
    return name.lower().replace(" ", "-")

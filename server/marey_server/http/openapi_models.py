"""JSON schemas in the OpenAPI document: of models, documents, files and plain bytes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import JsonSchemaMode, models_json_schema

from marey_schemas.base import Request
from marey_schemas.documents.registry import SCHEMAS
from marey_schemas.problems import Problem
from marey_server.http.declarations import Operation

Schema = dict[str, Any]

REF = "#/components/schemas/{model}"
_DOCUMENT = "Document"
"""Name of the schema that matches every kind of document."""


class ApiModels:
    """JSON schemas of all models in requests and answers, and references to them."""

    def __init__(self, operations: Iterable[Operation]) -> None:
        wanted: dict[tuple[type[BaseModel], JsonSchemaMode], None] = {(Problem, "serialization"): None}
        for operation in operations:
            for answer in (operation.answer, *(model for _, model in operation.also)):
                if answer is not None and issubclass(answer, BaseModel):
                    wanted[answer, "serialization"] = None
            for taken in (operation.body.content, operation.body.alternative) if operation.body else ():
                if taken is not None and issubclass(taken, BaseModel):
                    wanted[taken, "validation"] = None
        wanted |= {(model, "validation"): None for model in SCHEMAS.values()}
        self._refs, definitions = models_json_schema(list(wanted), ref_template=REF)
        self.components: dict[str, Schema] = definitions.get("$defs", {})
        for name, schema in self.components.items():
            _name_inner_objects(name, schema, self.components)
            for inner in schema.get("properties", {}).values():
                _describe_default(inner)
        self.components[_DOCUMENT] = {
            "description": "A document of any kind; its member `schema` names the kind.",
            "anyOf": [self.reading(model) for model in SCHEMAS.values()],
        }

    def reading(self, model: type[BaseModel]) -> Schema:
        """Return a `$ref` to the schema of a model in requests."""
        return dict(self._refs[model, "validation"])

    def writing(self, model: type[BaseModel]) -> Schema:
        """Return a `$ref` to the schema of a model in answers."""
        return dict(self._refs[model, "serialization"])

    def partial(self, model: type[BaseModel]) -> Schema:
        """Return a `$ref` to a new schema: the model's schema in answers, but without required fields."""
        name = f"Some{model.__name__}"
        full = self.components[self.writing(model)["$ref"].rpartition("/")[2]]
        self.components[name] = {key: value for key, value in full.items() if key != "required"} | {"title": name}
        return {"$ref": REF.format(model=name)}

    def document(self) -> Schema:
        """Return a `$ref` to the schema that matches every kind of document.

        The schema uses `anyOf`, not `oneOf`, because the schema of `OpenDocument` also matches documents of other
        schemas.
        """
        return {"$ref": REF.format(model=_DOCUMENT)}


def bytes_schema(media_type: str) -> Schema:
    """Return the schema of a body or an answer that consists of the bytes of a file of this media type."""
    if media_type.startswith("text/"):
        return {"type": "string"}
    return {"type": "object"} if media_type == "application/json" else {"type": "string", "format": "binary"}


def form_schema(options: type[Request]) -> Schema:
    """Return the schema of a form with files, and with a text field for each of the options.

    A list is one field with commas between its elements.
    """
    fields = options.model_json_schema(by_alias=True)["properties"]
    files = {"type": "array", "items": bytes_schema("application/octet-stream"), "minItems": 1}
    shown = {name: _form_field(without_null(field)) for name, field in fields.items()}
    for field in shown.values():
        _describe_default(field)
    return {
        "type": "object",
        "properties": {"files": files | {"description": "The files, each with its name."}, **shown},
        "required": ["files"],
    }


def _form_field(schema: Schema) -> Schema:
    if schema.get("type") != "array":
        return schema
    description = f"{schema['description'].rstrip('.')}; separated by commas."
    return {"type": "string", "description": description}


def without_null(schema: Schema) -> Schema:
    """Return the schema of a parameter or form field without null: a client omits it instead of sending null."""
    shown = {key: value for key, value in schema.items() if key not in ("title", "default") or schema[key] is not None}
    shown.pop("title", None)
    choices = [choice for choice in shown.pop("anyOf", ()) if choice.get("type") != "null"]
    if len(choices) == 1:
        shown |= choices[0]
    elif choices:
        shown["anyOf"] = choices
    return shown


def _describe_default(schema: Schema) -> None:
    """Move the default of a member from the schema into the description of the member.

    Otherwise, generated clients would send the default, although an absent member can mean more than its default. A
    constant keeps its default: it names the kind of a document, which clients must send.
    """
    if "const" in schema or "default" not in schema:
        return
    default = schema.pop("default")
    if default is None:
        return
    text = schema.get("description", "").rstrip()
    shown = json.dumps(default, ensure_ascii=False)
    schema["description"] = f"{text}{'' if not text or text.endswith('.') else '.'} Default: {shown}.".lstrip()


def _name_inner_objects(model: str, schema: Schema, components: dict[str, Schema]) -> None:
    """Remove the titles of schemas inside a model, because two of them could have the same title.

    Generated clients then name the class of an object inside a model by the model and the property. If another model
    has this name, the object gets a title, from which clients make another name.
    """
    for name, inner in schema.get("properties", {}).items():
        for one in _inner_schemas(inner):
            one.pop("title", None)
        named = f"{model}{name.replace('_', ' ').title().replace(' ', '')}"
        if named in components and inner.get("type") == "object":
            inner["title"] = f"{name} by name"


def _inner_schemas(schema: Schema) -> Iterator[Schema]:
    """Yield a schema and all schemas inside it; schemas that are only referenced (`$ref`) are left out."""
    yield schema
    below = [*schema.get("properties", {}).values(), *schema.get("prefixItems", ())]
    below += [one for key in ("anyOf", "oneOf", "allOf") for one in schema.get(key, ())]
    below += [schema[key] for key in ("items", "additionalProperties") if isinstance(schema.get(key), dict)]
    for one in below:
        yield from _inner_schemas(one)

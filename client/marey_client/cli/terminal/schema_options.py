"""Options of commands that come from a model of `marey_schemas`: names, types, ranges, defaults and help.

The options are made when their command runs or shows its help, so that `marey --help` imports no models:

    add_command(app, retarget, params=OptionsOf("marey_schemas.queue.job_params:RetargetParams"))

The parameter `params` of `retarget` then gets the given options, validated, as a dict. An option has the name of its
field; commands add shorter spellings.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import typer
from typer.core import TyperCommand

from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.typed_values import (
    Schema,
    default_text,
    named_number,
    parameters_of,
    range_text,
    read_number,
    read_numbers,
    without_null,
)
from marey_schemas.validation.reasons import plain_reason

if TYPE_CHECKING:
    from pydantic import BaseModel

Chosen = dict[str, Any]
"""Values of the options given on the command line, by field of the model."""

NONE = "none"
"""Text that means null in options whose default is not null."""


@dataclass(frozen=True)
class OptionsOf:
    """Options of a command, one for each field of a model.

    Parameters
    ----------
    model : module and name of the model, as `module:name`
    short : further spellings of an option, by the name of its field
    without : fields that get no option, because the command sets them
    only : fields that get an option; all fields if empty
    nulls : a text that means null in addition to `none`, by the name of the field
    defaults : description of a default that the command sets instead of the default of the model, by the name of the
        field
    """

    model: str
    short: Mapping[str, str | Sequence[str]] = field(default_factory=dict)
    without: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    nulls: Mapping[str, str] = field(default_factory=dict)
    defaults: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def options(self) -> tuple[_Option, ...]:
        """The options in the order of the fields; a nested model is replaced by its fields."""
        return tuple(self._made(parameters_of(self._model), ()))

    def read(self, typed: Mapping[str, Any]) -> Chosen:
        """Return the given options as fields of the model. Raises `WrongUsage` if the model refuses them."""
        from pydantic import ValidationError

        chosen: Chosen = {}
        for option in self.options:
            if (value := typed[option.key]) not in (None, []):
                _put(chosen, option.path, option.read(value))
        try:
            self._model.model_validate(chosen)
        except ValidationError as error:
            for one in error.errors(include_url=False):
                if one["type"] != "missing":  # that the command adds
                    raise WrongUsage(f"{self._spelled(one['loc'])}{plain_reason(one)}") from None
        return chosen

    @cached_property
    def _model(self) -> type[BaseModel]:
        module, _, name = self.model.partition(":")
        model: type[BaseModel] = getattr(import_module(module), name)
        return model

    def _made(self, schemas: Mapping[str, Schema], within: tuple[str, ...]) -> Iterator[_Option]:
        for name, schema in schemas.items():
            if name in self.without or (self.only and name not in self.only and not within):
                continue
            path = (*within, name)
            if "discriminator" in schema:
                tag = schema["discriminator"]
                path = (*path, tag["propertyName"])
                schema = {"enum": list(tag["mapping"]), "description": schema.get("description", "")}
            elif "properties" in schema and not _holds_numbers(schema):
                yield from self._made(schema["properties"], path)
                continue
            short = _several(self.short.get(path[-1], ()))
            yield _Option(path, schema, short, self.nulls.get(name), self.defaults.get(name))

    def _spelled(self, place: tuple[int | str, ...]) -> str:
        """Return the beginning of an error text: the option for the field that has this path in the model."""
        fitting = (one for one in self.options if place[: len(one.path)] == one.path)
        option = next(fitting, None)
        if option is None:
            return f"{'.'.join(map(str, place))}: " if place else ""
        return f"{option.spellings[0]}: "


@dataclass(frozen=True)
class _Option:
    path: tuple[str, ...]
    schema: Schema
    short: tuple[str, ...]
    null: str | None
    default: str | None

    @property
    def key(self) -> str:
        return "chosen__" + "__".join(self.path)

    @cached_property
    def spellings(self) -> tuple[str, ...]:
        name = self.path[-1].replace("_", "-")
        if self._form in ("texts", "assignments") and name.endswith("s"):
            name = name[:-1]  # it is repeated, one each
        return (f"--{name}", *(one for one in self.short if one != f"--{name}"))

    def parameter(self) -> inspect.Parameter:
        """Return the function parameter from which typer creates this option."""
        declared = [f"{one}/--no-{one[2:]}" for one in self.spellings] if self._form == "boolean" else self.spellings
        option = typer.Option(*declared, help=self.help, metavar=self._metavar, show_default=False)
        return inspect.Parameter(
            self.key, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[self._type, option]
        )

    def read(self, typed: Any) -> Any:
        """Convert a typed value to the type of the field. Raises `WrongUsage` for a text that has another form."""
        spelled = self.spellings[0]
        if self._form == "number or none":
            return None if typed in (NONE, self.null) else read_number(typed, spelled)
        if self._form == "numbers":
            return read_numbers(typed, self._schema.get("maxItems"))
        if self._form == "choices":
            return typed.split(",")
        if self._form == "assignments":
            return dict(named_number(one, self._schema.get("properties")) for one in typed)
        return typed

    @property
    def help(self) -> str:
        """Return the help text of an option: description, range, default, and the syntax for several values."""
        meaning = self.schema.get("description", "")
        if self._form == "number or none":  # nobody can type the null of JSON
            meaning = meaning.replace("null: ", f"{NONE}{f' or {self.null}' if self.null else ''}: ")
        notes = [
            range_text(self._schema),
            f"names: {', '.join(names)}" if (names := self._schema.get("properties")) else "",
            *(["may be repeated"] if self._form in ("texts", "assignments") else []),
            *(["a,b,c or first:last:step"] if self._form == "numbers" else []),
            f"default: {self.default}" if self.default else "",
            f"default {default}" if not self.default and (default := default_text(self.schema)) else "",
        ]
        note = "; ".join(filter(None, notes))
        return f"{meaning} {note[:1].upper()}{note[1:]}.".strip() if note else meaning

    @cached_property
    def _schema(self) -> Schema:
        return without_null(self.schema)

    @cached_property
    def _form(self) -> str:
        schema = self._schema
        kind = str(schema.get("type", "string"))
        if "enum" in schema or "const" in schema:
            return "choice"
        if kind == "object":
            return "assignments"
        if kind == "array":
            items = schema.get("items", {})
            return "choices" if "enum" in items else ("texts" if items.get("type") == "string" else "numbers")
        if kind in ("integer", "number") and schema is not self.schema and self.schema.get("default") is not None:
            return "number or none"
        return kind

    @property
    def _type(self) -> Any:
        if self._form == "choice":
            values = self._schema.get("enum") or [self._schema["const"]]
            return Literal[tuple(values)] | None  # pyrefly: ignore[invalid-literal]  # the choices come from a schema
        plain = {"integer": int, "number": float, "boolean": bool, "texts": list[str], "assignments": list[str]}
        return plain.get(self._form, str) | None

    @property
    def _metavar(self) -> str | None:
        if self._form == "choices":
            return ",".join(map(str, self._schema["items"]["enum"]))
        written = {"texts": "TEXT", "numbers": "NUMBERS", "assignments": "NAME=NUMBER", "number or none": "NUMBER"}
        return written.get(self._form)


class SchemaCommand(TyperCommand):
    """Command whose options come from models.

    A subclass sets `function`, the function to run, and `groups`: for each parameter of the function that receives the
    options of a model, the `OptionsOf` of this model.
    """

    function: ClassVar[Callable[..., Any]]
    groups: ClassVar[Mapping[str, OptionsOf]]


def add_command(app: typer.Typer, function: Callable[..., Any], name: str | None = None, **options: OptionsOf) -> None:
    """Register a command; the parameters named in `options` receive the options given for their models."""

    class Command(SchemaCommand):
        groups = options

        @cached_property
        def whole(self) -> TyperCommand:
            one = typer.Typer(add_completion=False, rich_markup_mode=None)
            one.command(name)(expanded(function, options))
            whole = typer.main.get_command(one)
            assert isinstance(whole, TyperCommand)
            return whole

        def get_params(self, ctx: Any) -> Any:
            return self.whole.get_params(ctx)

        def invoke(self, ctx: Any) -> Any:
            return self.whole.invoke(ctx)

    Command.function = staticmethod(function)

    def stub() -> None: ...

    stub.__name__, stub.__doc__ = function.__name__, function.__doc__
    app.command(name, cls=Command)(stub)


def expanded(function: Callable[..., Any], groups: Mapping[str, OptionsOf]) -> Callable[..., Any]:
    """Return a function that has each option as a parameter, and calls `function` with the given options."""

    def run(**typed: Any) -> Any:
        for name, group in groups.items():
            given = {option.key: typed.pop(option.key) for option in group.options}
            typed[name] = group.read(given)
        return function(**typed)

    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
        if name in groups:
            parameters += (option.parameter() for option in groups[name].options)
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    run.__name__, run.__doc__ = function.__name__, function.__doc__
    run.__signature__ = inspect.Signature(parameters)  # pyrefly: ignore[missing-attribute]  # read by `inspect`
    run.__annotations__ = {one.name: one.annotation for one in parameters}
    return run


def _holds_numbers(schema: Schema) -> bool:
    return all(one.get("type") == "number" for one in schema["properties"].values())


def _several(spellings: str | Sequence[str]) -> tuple[str, ...]:
    return (spellings,) if isinstance(spellings, str) else tuple(spellings)


def _put(chosen: Chosen, path: Sequence[str], value: Any) -> None:
    place = chosen
    for name in path[:-1]:
        place = place.setdefault(name, {})
    place[path[-1]] = value

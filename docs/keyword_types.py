"""Types of the keyword arguments of the SDK, written from the declarations of options.

Each method that takes `**options` takes the fields of one model of `marey_schemas`. A `TypedDict` with the same fields
lets editors complete them, and type checkers check them; pydantic checks the values when the method is called.
"""

from __future__ import annotations

import textwrap
import types
from collections import defaultdict
from collections.abc import Iterator, Mapping
from datetime import date
from enum import Enum
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel

from marey_schemas import purges, search
from marey_schemas.base import Options, Tagged
from marey_schemas.documents.differences import DifferenceOptions
from marey_schemas.editing.previews import EditPreviewRequest
from marey_schemas.lineage import LineageOptions
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue import job_params
from marey_schemas.queue.model_pipelines import ModelPlan

WIDTH = 120
HEAD = '''"""Keyword arguments of methods of the SDK: {subject}.

Written by `make docs` from the declarations of the options; change them there.
"""

from __future__ import annotations
'''
METRIC = ("metric",)
"""Field of parameters that methods take as an argument of their own, which may also be a handle."""
PLACED = ("name", "files", "clips", "rigs", "annotations")
"""Fields of a plan of a model that `build_model` fills from its other arguments."""

Taken = Mapping[type[BaseModel], tuple[str, ...]]
"""Models whose fields are keyword arguments, each with the fields that the method takes in another way."""

MODULES: Mapping[str, tuple[str, Taken]] = {
    "evaluation": (
        "parameters of evaluations and of jobs that improve clips",
        {
            job_params.EvaluateParams: METRIC,
            job_params.CompareParams: (),
            job_params.SuggestParams: METRIC,
            job_params.OptimiseParams: (),
            job_params.SweepParams: (),
        },
    ),
    "processing": (
        "parameters of jobs that make or measure clips and models",
        {
            job_params.AnnotateParams: ("proposal",),
            job_params.CutParams: (),
            job_params.IndexParams: (),
            job_params.AlignParams: METRIC,
            job_params.EditParams: ("commands",),
            job_params.DistancesParams: METRIC,
            job_params.QualityParams: (),
            job_params.ModelParams: (),
            job_params.TreeParams: (),
            job_params.AnalyseStudyParams: (),
            ModelPlan: PLACED,
        },
    ),
    "asking": (
        "options of imports, searches and other requests that are not jobs",
        {
            ImportOptions: (),
            DifferenceOptions: (),
            LineageOptions: (),
            EditPreviewRequest: ("commands", "edit", "frames"),
            search.SearchRequest: ("constraints",),
            search.SimilarOptions: METRIC,
            purges.PurgeRequest: (),
        },
    ),
}
"""Modules of `marey_client.keywords`: a description of the arguments, and the models of these arguments."""


def keyword_modules() -> dict[str, str]:
    """Return the text of every generated module of `marey_client.keywords`, by its file name."""
    return {f"{name}.py": KeywordModule(taken).text(subject) for name, (subject, taken) in MODULES.items()}


def keywords_name(model: type[BaseModel]) -> str:
    """Return the name of the `TypedDict` with the fields of a model: `CutKeywords` for `CutParams`."""
    name = model.__name__
    for ending in ("Params", "Options", "Request"):
        name = name.removesuffix(ending)
    return f"{name}Keywords"


class _Field(NamedTuple):
    name: str
    type: str
    note: str


class KeywordModule:
    """Text of one module, with its classes in the order of their use, and the imports that their types need."""

    def __init__(self, taken: Taken) -> None:
        self._classes: dict[str, tuple[str, list[_Field]]] = {}
        self._imports: defaultdict[str, set[str]] = defaultdict(set)
        self._imports["typing"].add("TypedDict")
        for model, without in taken.items():
            self._add(model, without)

    def text(self, subject: str) -> str:
        """Return the source of the module, formatted as ruff formats it."""
        imports = [f"from {module} import {', '.join(sorted(names))}" for module, names in self._imports.items()]
        ours = sorted(line for line in imports if "marey_" in line)
        others = sorted(line for line in imports if "marey_" not in line)
        groups = ["\n".join(lines) for lines in (others, ours) if lines]
        classes = ["\n".join(self._class_lines(*one)) for one in self._classes.items()]
        return "\n".join([HEAD.format(subject=subject), "\n\n".join(groups), *(f"\n\n{one}" for one in classes)]) + "\n"

    def _class_lines(self, name: str, content: tuple[str, list[_Field]]) -> Iterator[str]:
        model, fields = content
        yield f"class {name}(TypedDict, total=False):"
        yield f'    """Keyword arguments, one for each field of `{model}`."""'
        yield ""
        for field in fields:
            yield f"    {field.name}: {field.type}"
            if field.note:
                quoted = field.note.replace("\\", "\\\\")
                lines = textwrap.wrap(f'"""{quoted}"""', WIDTH - 4, break_long_words=False, break_on_hyphens=False)
                yield from (f"    {line}" for line in lines)

    def _add(self, model: type[BaseModel], without: tuple[str, ...] = ()) -> str:
        name = keywords_name(model)
        if name not in self._classes:
            fields = [
                _Field(key, self._written(field.annotation), field.description or "")
                for key, field in model.model_fields.items()
                if key not in without
            ]
            self._classes[name] = (model.__name__, fields)
        return name

    def _written(self, kind: Any) -> str:
        """Return the source text of a type; it accepts lists in place of tuples, and documents in place of models."""
        return " | ".join(self._parts(kind))

    def _parts(self, kind: Any) -> list[str]:
        """Return the different types of a union, each as it is written in Python; one for a type that is no union."""
        origin, arguments = get_origin(kind), get_args(kind)
        if origin is Annotated:
            return self._parts(arguments[0])
        if origin in (Union, types.UnionType):
            return list(dict.fromkeys(part for one in arguments for part in self._parts(one)))
        if origin is Literal:
            self._imports["typing"].add("Literal")
            choices = ", ".join(f'"{one}"' for one in arguments)
            return [f"Literal[{choices}]"]
        if origin is tuple:
            return self._parts_of_tuple(arguments)
        if origin is dict:
            self._imports["collections.abc"].add("Mapping")
            key, value = map(self._written, arguments)
            return [f"Mapping[{key}, {value}]"]
        return self._parts_of_class(kind)

    def _parts_of_tuple(self, arguments: tuple[Any, ...]) -> list[str]:
        if arguments[-1] is not Ellipsis:
            return [f"tuple[{', '.join(map(self._written, arguments))}]"]
        one = self._written(arguments[0])
        if one == "str":
            return ["list[str]", "tuple[str, ...]"]  # not Sequence, because a text would be one
        self._imports["collections.abc"].add("Sequence")
        return [f"Sequence[{one}]"]

    def _parts_of_class(self, kind: Any) -> list[str]:
        if kind is type(None):
            return ["None"]
        if kind.__module__ == "builtins":
            return [str(kind.__name__)]
        self._imports[kind.__module__].add(kind.__name__)
        if issubclass(kind, Enum | date):
            return [kind.__name__, "str"]
        if issubclass(kind, Options) and not issubclass(kind, Tagged):
            return [kind.__name__, self._add(kind)]
        if issubclass(kind, BaseModel):
            self._imports["collections.abc"].add("Mapping")
            self._imports["typing"].add("Any")
            return [kind.__name__, "Mapping[str, Any]"]
        raise TypeError(f"{kind}: say in docs/keyword_types.py how this type is written")

"""Arguments of functions: check of types, validation by models, and arguments that accept one value or several."""

from __future__ import annotations

import builtins
import inspect
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from functools import cached_property, wraps
from itertools import chain
from numbers import Integral, Real
from pathlib import Path
from types import FunctionType, NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints, is_typeddict

from pydantic import BaseModel, ValidationError

from marey_client.errors import BadArgument
from marey_schemas.validation.reasons import first_reason
from marey_schemas.wording import one_of

Model = TypeVar("Model", bound=BaseModel)
Owner = TypeVar("Owner", bound=Callable[..., Any])
Test = Callable[[Any], bool]

LONGEST_SHOWN = 60
"""Greatest number of characters of a value that an error shows."""


def checked(model: type[Model], values: Mapping[str, Any] | None = None, /, **more: Any) -> Model:
    """Return an instance of `model` with these values. Raises `BadArgument`, which names the first invalid field."""
    given = {**(values or {}), **more}
    try:
        return model.model_validate(given)
    except ValidationError as error:
        raise BadArgument(first_reason(error, model, given)) from error


def several(given: str | Path | Mapping[str, Any] | BaseModel | Iterable[Any]) -> tuple[Any, ...]:
    """Return an argument, which is one value or several values, as a tuple of values.

    A text, a path, a document or a pydantic model counts as one value.
    """
    return (given,) if isinstance(given, (str, Path, Mapping, BaseModel)) else tuple(given)


# -- types -------------------------------------------------------------------------------------------------------------


def checks_arguments(owner: Owner) -> Owner:
    """Let a function, or the public methods of a class, raise `BadArgument` if an argument has a wrong type.

    Methods that a class inherits are checked only if the class that defines them has the decorator, too.
    """
    if isinstance(owner, FunctionType):
        return _checking(owner)
    for name, member in tuple(vars(owner).items()):
        public = not name.startswith("_") or name == "__getitem__"
        if public and isinstance(member, FunctionType) and member.__module__ == owner.__module__:
            setattr(owner, name, _checking(member))
    return owner


def _checking(function: Owner) -> Owner:
    parameters = Parameters(function)

    @wraps(function)
    def checking(*args: Any, **kwargs: Any) -> Any:
        for reason in parameters.wrong(args, kwargs):
            raise BadArgument(reason)
        return function(*args, **kwargs)

    return cast("Owner", checking)


class Parameters:
    """Parameters of a function. Their types are read when the function is first called."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    @cached_property
    def types(self) -> dict[str, Any]:
        """The type of each parameter; `Any` for `self`, and in place of types that only type checkers import."""
        known = get_type_hints(self._function, localns=_AnnotationNames(self._function.__globals__))
        return {name: known.get(name, Any) for name in inspect.signature(self._function).parameters}

    @cached_property
    def _of_kind(self) -> dict[Any, list[str]]:
        found: dict[Any, list[str]] = {}
        for one in inspect.signature(self._function).parameters.values():
            found.setdefault(one.kind, []).append(one.name)
        return found

    @cached_property
    def _in_order(self) -> list[str]:
        kinds = inspect.Parameter
        return [*self._of_kind.get(kinds.POSITIONAL_ONLY, ()), *self._of_kind.get(kinds.POSITIONAL_OR_KEYWORD, ())]

    @cached_property
    def _tests(self) -> dict[str, Test]:
        return {name: _test_of(wanted) for name, wanted in self.types.items()}

    @cached_property
    def _others(self) -> str:
        """The name of the parameter that takes unknown keywords; an empty text if there is none."""
        return self._of_kind.get(inspect.Parameter.VAR_KEYWORD, [""])[0]

    def wrong(self, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Iterator[str]:
        """Yield what is wrong with the types in a call. Missing and unknown arguments are left to Python."""
        for name, value in chain(zip(self._in_order, args, strict=False), kwargs.items()):
            declared = name if name in self._tests else self._others
            if declared and not self._tests[declared](value):
                yield from _reasons(name, value, self.types[declared])


class _AnnotationNames(dict[str, Any]):
    """Names of a module; names that neither the module nor Python itself defines are `Any`."""

    def __missing__(self, name: str) -> Any:
        if hasattr(builtins, name):
            raise KeyError(name)
        return Any


def _reasons(name: str, value: Any, wanted: Any) -> Iterator[str]:
    """Yield the reason if a value does not have a type. Inside a list or dict, the reason names the wrong entry."""
    if _test_of(wanted)(value):
        return
    for choice in _choices(wanted):
        if _is_container(choice) and _test_of(get_origin(choice))(value):
            for place, entry in _entries(value):
                yield from _reasons(f"{name}[{place!r}]", entry, _type_of_entries(choice))
            return
    yield f"{name}: give {one_of(list(dict.fromkeys(map(_described, _choices(wanted)))))}, not {_shown(value)}"


def _test_of(wanted: Any) -> Test:
    """Return the test whether a value has a type. Types that cannot be tested, such as protocols, fit every value."""
    choices, origin = _choices(wanted), get_origin(wanted)
    if len(choices) > 1:
        tests = tuple(map(_test_of, choices))
        return lambda value: any(test(value) for test in tests)
    if origin is Literal:
        allowed = {(type(one), one) for one in get_args(wanted)}
        return lambda value: isinstance(value, Hashable) and (type(value), value) in allowed
    if _is_container(wanted):
        whole, entry = _test_of(origin), _test_of(_type_of_entries(wanted))
        return lambda value: whole(value) and all(entry(one) for _, one in _entries(value))
    return _test_of_class(origin or choices[0])


def _test_of_class(kind: Any) -> Test:
    if kind is Any or not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
        return _fits_anything
    if is_typeddict(kind):
        return lambda value: isinstance(value, Mapping)
    if issubclass(kind, Enum):
        texts = {one.value for one in kind}
        return lambda value: isinstance(value, kind) or (isinstance(value, str) and value in texts)
    if kind in _NUMBERS:
        return lambda value: isinstance(value, _NUMBERS[kind]) and not isinstance(value, bool)
    if kind in _LISTS:
        return lambda value: isinstance(value, Iterable) and not isinstance(value, (str, bytes, Mapping, BaseModel))
    return lambda value: isinstance(value, kind)


def _fits_anything(_value: Any) -> bool:
    return True


_NUMBERS: dict[Any, tuple[type, ...]] = {int: (int, Integral), float: (float, int, Real)}
"""Classes of the numbers that fit `int` and `float`; `Integral` and `Real` include the numbers of numpy."""
_LISTS: tuple[Any, ...] = (Sequence, Iterable, Collection)
"""Types for which any iterable fits, because functions copy it; a text is one value, not several characters."""
_WORDS = {"Callable": "a function", "ndarray": "a numpy array", "slice": "a range such as slice(0, 120)"}
"""Words for types whose names say little, by name."""


def _choices(wanted: Any) -> tuple[Any, ...]:
    """Return the types of a union, also of a type variable; for other types, the type itself."""
    if isinstance(wanted, TypeVar):
        return _choices(wanted.__bound__ or Any)
    if get_origin(wanted) in (Union, UnionType):
        return tuple(chain.from_iterable(map(_choices, get_args(wanted))))
    return (wanted,)


def _is_container(wanted: Any) -> bool:
    """Return whether a type is that of a list or dict with entries of known types."""
    origin = get_origin(wanted)
    return origin in _LISTS or origin in (list, set, frozenset) or _is_dict(wanted)


def _is_dict(wanted: Any) -> bool:
    origin = get_origin(wanted)
    return isinstance(origin, type) and issubclass(origin, Mapping)


def _type_of_entries(wanted: Any) -> Any:
    return get_args(wanted)[1 if _is_dict(wanted) else 0]


def _entries(value: Any) -> Iterable[tuple[Any, Any]]:
    """Return place and value of each entry of a list, set or dict; nothing for iterators, which this would consume."""
    if isinstance(value, Mapping):
        return value.items()
    return enumerate(value) if isinstance(value, (list, tuple, set, frozenset)) else ()


def _described(wanted: Any) -> str:
    """Return a type in words, with its article."""
    if wanted is NoneType:
        return "None"
    if get_origin(wanted) is Literal:
        return one_of([repr(one) for one in get_args(wanted)])
    if _is_container(wanted) and not _is_dict(wanted):
        entries = map(_described, _choices(get_args(wanted)[0]))
        return f"a list of {one_of([one.removeprefix('a ').removeprefix('an ') for one in entries])}"
    kind = get_origin(wanted) or wanted
    if _is_dict(wanted) or is_typeddict(kind):
        return "a dict"
    if kind.__name__ in _WORDS:
        return _WORDS[kind.__name__]
    if issubclass(kind, Enum):
        return one_of([repr(str(one.value)) for one in kind])
    return f"{'an' if kind.__name__[0] in 'AEIOUaeiou' else 'a'} {kind.__name__}"


def _shown(value: Any) -> str:
    """Return a value with its type, shortened."""
    if value is None:
        return "None"
    shape = getattr(value, "shape", None)
    text = f"an array of shape {shape}" if isinstance(shape, tuple) and shape else repr(value)
    text = text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN - 3]}..."
    return f"{text} ({type(value).__name__})"

"""Validation of query parameters and bodies by their models; the place of each fault is reported."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from marey_schemas.encoding import codecs
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.encoding.compression import CompressionError, content_size, decompress
from marey_schemas.problems import FieldError
from marey_server.errors import BadRequestProblem, InvalidProblem, TooLargeProblem
from marey_server.field_errors import MAX_ERRORS, field_errors, json_pointer

Model = TypeVar("Model", bound=BaseModel)


def parse_query(model: type[Model] | None, arguments: Mapping[str, Sequence[bytes]]) -> Model | None:
    """Return the query parameters as `model`; None if the operation has no `model`, and so no parameters.

    Raises `BadRequestProblem` for unknown, repeated or invalid parameters. Unknown parameters are ignored if the
    configuration of the model says so (`extra="ignore"`).
    """
    known = {field.alias or name: field for name, field in model.model_fields.items()} if model else {}
    values: dict[str, str] = {}
    faults = []
    for name, given in arguments.items():
        if name not in known:
            if model is not None and model.model_config.get("extra") == "ignore":
                continue
            faults.append(FieldError(pointer=name, code="unknown-parameter", detail=_known_parameters(known)))
        elif len(given) > 1:
            faults.append(
                FieldError(
                    pointer=name,
                    code="repeated",
                    detail="Give this parameter only once; separate several values with commas.",
                )
            )
        else:
            try:
                values[name] = given[0].decode()
            except UnicodeDecodeError:
                faults.append(
                    FieldError(pointer=name, code="not-utf8", detail="The value must be percent-encoded UTF-8.")
                )
            if b"\0" in given[0]:
                faults.append(FieldError(pointer=name, code="bad-text", detail="A text may not contain NUL."))
    if faults:
        raise _bad_query(faults)
    if model is None:
        return None
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise _bad_query(field_errors(error, model, values, ".".join)) from None


def _known_parameters(known: Mapping[str, Any]) -> str:
    return f"The known parameters are {', '.join(sorted(known))}." if known else "This address has no parameters."


def _bad_query(faults: list[FieldError]) -> BadRequestProblem:
    first = f"{faults[0].pointer}: {faults[0].detail}"
    return BadRequestProblem(f"The query is not valid: {first}", code="bad-query", errors=faults[:MAX_ERRORS])


def stated_size(compressed: bytes, most_bytes: int) -> int:
    """Return the number of bytes that a compressed body states for its content.

    Raises `TooLargeProblem` for more than `most_bytes`, and `BadRequestProblem` if the body states no size.
    """
    try:
        size = content_size(compressed)
    except CompressionError as error:
        raise _not_compressed(error) from None
    if size > most_bytes:
        raise TooLargeProblem(f"Decompressed, the body has {size} bytes; this address accepts at most {most_bytes}.")
    return size


def decompressed(compressed: bytes) -> bytes:
    """Return the content of a compressed body. Raises `BadRequestProblem` if the body is damaged."""
    try:
        return decompress(compressed)
    except CompressionError as error:
        raise _not_compressed(error) from None


def _not_compressed(error: CompressionError) -> BadRequestProblem:
    return BadRequestProblem(f"The request body cannot be decompressed: {error}.", code="bad-compression")


def decode_body(
    data: bytes,
    media_type: str,
    *,
    max_array_bytes: int,
    keep_blocks: bool = False,
    take_bytes: Callable[[int], None] | None = None,
) -> Any:
    """Return the tree in a body; the keyword arguments are passed to `codecs.decode_tree`.

    Raises `BadRequestProblem` if the body cannot be decoded, and `InvalidProblem` if the tree contains values that are
    not allowed.
    """
    try:
        return codecs.decode_tree(
            data, media_type, max_array_bytes=max_array_bytes, keep_blocks=keep_blocks, take_bytes=take_bytes
        )
    except codecs.CodecError as error:
        fault = FieldError(pointer=error.pointer, code=error.code, detail=error.detail)
        if error.code == "too-large":
            raise TooLargeProblem(error.detail, errors=[fault]) from None
        refusal = BadRequestProblem if error.code == "bad-syntax" else InvalidProblem
        raise refusal(f"The request body cannot be read: {error}.", code=error.code, errors=[fault]) from None


def validate_body(model: type[Model], tree: Any) -> Model:
    """Return a tree as `model`, without conversion of types: "5" is not a number.

    Raises `InvalidProblem` with a JSON Pointer for each fault.
    """
    if not isinstance(tree, Mapping):
        tree = None  # refused as any other value that is not an object, without a look at thousands of items
    try:
        if survey(tree):
            return model.model_validate(tree)
        return model.model_validate_json(canonical_json(tree), strict=True)  # in which 1.0 is the integer 1
    except ValidationError as error:
        faults = field_errors(error, model, tree)
        first = f"{faults[0].pointer or 'the body'}: {faults[0].detail}"
        raise InvalidProblem(f"The request body is not valid: {first}", code="invalid-body", errors=faults) from None


def survey(tree: Any, steps: tuple[str, ...] = ()) -> bool:
    """Return whether a tree contains arrays, and check its texts.

    Raises `InvalidProblem` for a text with a NUL character, which databases do not store.
    """
    if isinstance(tree, Mapping):
        return sum(survey(member, (*steps, key)) for key, member in tree.items()) > 0
    if isinstance(tree, list):
        return sum(survey(item, (*steps, str(index))) for index, item in enumerate(tree)) > 0
    if isinstance(tree, str) and "\0" in tree:
        fault = FieldError(pointer=json_pointer(steps), code="bad-text", detail="A text may not contain NUL.")
        raise InvalidProblem(
            f"The request body is not valid: {fault.pointer}: {fault.detail}", code="bad-text", errors=[fault]
        )
    return isinstance(tree, np.ndarray | EncodedArray)

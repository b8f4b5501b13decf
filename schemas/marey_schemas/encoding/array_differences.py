"""Array differences: only the frames of an array are sent that differ from another array, which the receiver has.

In a document, such an *array difference* is an object in place of the array. It names the other array, its *base*, by
the content digest of a revision and a JSON Pointer into the same part of this revision. The other members are `dtype`
and `shape`; `digest`, the content digest of the whole array; `frames`, the indices of the frames that differ; and
`difference`, the new values of these frames minus the values of the base. The values are subtracted as unsigned
integers (see `tiles`), so that the sum is exact.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_schemas.encoding import blocks
from marey_schemas.encoding.arrays import EncodedArray, array_from_leaf, with_blocks
from marey_schemas.encoding.arrayspec import ArrayError, ArraySpec
from marey_schemas.encoding.canonical import array_digest
from marey_schemas.encoding.tiles import from_integers, to_integers

INDEX = "<u4"
"""Type of the indices of frames."""
MOST_CHANGED = 1 / 2
"""Share of changed frames above which the whole array is sent, because the array difference would hardly be smaller."""
_MEMBERS = frozenset({"base", "pointer", "dtype", "shape", "digest", "frames", "difference"})


@dataclass(frozen=True, slots=True)
class ArrayDifference:
    """Description of an array in a document: a base, and the frames in which the array differs from the base."""

    base: str
    """Content digest of the revision that has the base."""
    pointer: str
    dtype: str
    shape: tuple[int, ...]
    digest: str
    """Content digest of the whole array."""
    frames: NDArray[Any] | EncodedArray
    """Indices of the frames that differ, in ascending order."""
    difference: NDArray[Any] | EncodedArray
    """Differences (len(frames), columns), as unsigned integers of the size of the array's elements."""

    @classmethod
    def of(cls, value: Any) -> ArrayDifference | None:
        """Return `value`, a value in a document, as an array difference; None if it is none.

        Raises `ArrayError` if dtype or shape are malformed.
        """
        if not isinstance(value, Mapping) or value.keys() != _MEMBERS:
            return None
        spec = ArraySpec.parse(value["dtype"], value["shape"])
        return cls(**(dict(value) | {"dtype": spec.dtype, "shape": spec.shape}))

    @classmethod
    def between(
        cls, array: EncodedArray, base: EncodedArray, content: str, pointer: str, digest: str
    ) -> ArrayDifference | None:
        """Return the difference of an array from a base; None if the difference would not be smaller than the array.

        Also returns None if more than half of the frames differ, or if dtype, shape or layout of the two arrays differ.
        `content` and `pointer` name the base; `digest` is the content digest of the array. The arrays are decoded block
        by block, so that at most about half of the frames are in memory in decoded form.
        """
        spec = ArraySpec(array.dtype, array.shape)
        if spec != ArraySpec(base.dtype, base.shape) or not spec.shape:
            return None
        most = MOST_CHANGED * spec.shape[0]
        numbers: list[NDArray[np.intp]] = [np.empty(0, np.intp)]
        rows: list[NDArray[Any]] = [np.empty((0, _columns(spec)), _unsigned(spec))]
        try:
            for within in blocks.changed_blocks(array.data, base.data):
                new, old = (_integers(blocks.decode(one.data, frames=within), spec) for one in (array, base))
                changed = np.flatnonzero((new != old).any(axis=1))
                numbers.append(changed + within.start)
                rows.append(new[changed] - old[changed])
                if (most := most - len(changed)) < 0:
                    return None
        except blocks.BlockError:  # an array that was stored with another layout
            return None
        frames = np.concatenate(numbers).astype(INDEX)
        difference = EncodedArray.of(np.concatenate(rows))
        if len(difference.data) >= len(array.data) or not _is_worthwhile(len(frames), spec):
            return None
        return cls(content, pointer, spec.dtype, spec.shape, digest, frames, difference)

    @property
    def nbytes(self) -> int:
        """The size of the whole array in bytes."""
        return ArraySpec(self.dtype, self.shape).nbytes

    @property
    def document(self) -> dict[str, Any]:
        """The object that represents the array in a document."""
        return {
            "base": self.base, "pointer": self.pointer, "dtype": self.dtype, "shape": list(self.shape),
            "digest": self.digest, "frames": self.frames, "difference": self.difference,
        }  # fmt: skip

    def applied_to(self, base: EncodedArray) -> NDArray[Any] | EncodedArray:
        """Return the whole array, checked as if it had been sent whole; tiles without changes are those of the base.

        Raises `ArrayError` if the difference does not match the base, or if the result has another digest.
        """
        spec = ArraySpec(self.dtype, self.shape)
        if spec != ArraySpec(base.dtype, base.shape) or not spec.shape:
            raise ArrayError(
                "bad-array", f"the array difference describes an array {spec}, but its base has another dtype or shape"
            )
        frames, difference = self._checked(spec)
        dtype = np.dtype(spec.dtype)

        def add(table: NDArray[Any], rows: NDArray[np.intp], places: slice) -> None:
            table[rows] = from_integers(to_integers(table[rows]) + difference[places], dtype)

        try:
            data = blocks.with_edited_frames(base.data, frames, add)
        except blocks.BlockError as error:
            raise ArrayError("bad-array", str(error)) from error
        leaf = {"dtype": spec.dtype, "shape": spec.shape, "encoding": "blocks", "data": data}
        array = array_from_leaf(leaf)
        if array_digest(array) != self.digest:
            raise ArrayError(
                "bad-array", "the array that results from base and difference does not have the digest that was sent"
            )
        return with_blocks(leaf, array)

    def _checked(self, spec: ArraySpec) -> tuple[NDArray[np.intp], NDArray[Any]]:
        """Return `frames` and `difference` as arrays; sizes are checked before memory is allocated."""
        count = _length(self.frames)
        if not _is_worthwhile(count, spec):
            raise ArrayError(
                "bad-array", "an array difference must not have more frames or bytes than the array that it describes"
            )
        numbers = _decoded("frames", self.frames, ArraySpec(INDEX, (count,)))
        if (numbers[1:] <= numbers[:-1]).any() or (count and numbers[-1] >= spec.shape[0]):
            raise ArrayError("bad-array", "the frames of an array difference must be ascending indices of the array")
        difference = _decoded("difference", self.difference, ArraySpec(_unsigned(spec).str, (count, _columns(spec))))
        return numbers.astype(np.intp), difference


def detach_differences(tree: Any, keep: Callable[[ArrayDifference], None]) -> Any:
    """Return a document in which each array difference is replaced by a reference to the whole array.

    The references have the form that `detach_arrays` produces.

    `keep` is called with each array difference. Raises `ArrayError` if one is malformed.
    """
    if isinstance(tree, Mapping):
        found = ArrayDifference.of(tree)
        if found is None:
            return {key: detach_differences(member, keep) for key, member in tree.items()}
        keep(found)
        return {"dtype": found.dtype, "shape": list(found.shape), "content": found.digest}
    return [detach_differences(member, keep) for member in tree] if isinstance(tree, list) else tree


def _length(frames: Any) -> int:
    """Return the number of frames that a difference announces, before it is decoded."""
    if not isinstance(frames, EncodedArray | np.ndarray) or len(frames.shape) != 1:
        raise ArrayError("bad-array", "the member `frames` of an array difference must be a list of integers")
    return int(frames.shape[0])


def _is_worthwhile(count: int, spec: ArraySpec) -> bool:
    """Return whether a difference with `count` frames has no more frames and bytes than the array, both decoded."""
    itemsize = np.dtype(spec.dtype).itemsize
    return count <= spec.shape[0] and count * (np.dtype(INDEX).itemsize + _columns(spec) * itemsize) <= spec.nbytes


def _decoded(member: str, array: Any, expected: ArraySpec) -> NDArray[Any]:
    """Return a member of a difference as an array; its type and size are checked before it is decoded."""
    if isinstance(array, EncodedArray):
        if ArraySpec.parse(array.dtype, array.shape) == expected:
            return array.decode(max_bytes=expected.nbytes)
    elif isinstance(array, np.ndarray) and ArraySpec(array.dtype.str, array.shape) == expected:
        return array
    raise ArrayError("bad-array", f"the member `{member}` of this array difference must be an array {expected}")


def _columns(spec: ArraySpec) -> int:
    return int(np.prod(spec.shape[1:], dtype=np.int64))


def _unsigned(spec: ArraySpec) -> np.dtype[Any]:
    return np.dtype(f"<u{np.dtype(spec.dtype).itemsize}")


def _integers(frames: NDArray[Any], spec: ArraySpec) -> NDArray[Any]:
    """Return frames as unsigned integers (frames, columns), in the form in which differences are computed."""
    return to_integers(frames.reshape(len(frames), _columns(spec)))

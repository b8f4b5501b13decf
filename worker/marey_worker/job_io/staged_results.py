"""Results of a job, which are encoded and sent in batches while the job computes the next results."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import numpy as np

from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.arrayspec import require_finite
from marey_schemas.queue.worker_protocol import StagedOutput
from marey_worker.context import Context, JobRefused

BYTES_PER_STAGE = 4 << 20
"""Bytes of arrays, before compression, after which results are sent. A task of ordinary clips needs one request."""
OUTPUTS_PER_STAGE = 64

_encoder = ThreadPoolExecutor(1, thread_name_prefix="marey-encode")
"""Thread that encodes arrays of results; compression does not hold Python's global interpreter lock."""


class StagedResults:
    """Results of one job; several of them are staged in one request.

    `names` contains the names of all results so far.
    """

    def __init__(self, context: Context) -> None:
        self.names: set[str] = set()
        self._context = context
        self._ready: list[Future[StagedOutput]] = []
        self._ready_bytes = 0

    @property
    def count(self) -> int:
        """Return the number of results."""
        return len(self.names)

    def add(self, output: StagedOutput) -> None:
        """Add a result; it is sent together with others.

        Raises `JobRefused` if an earlier result has the same name, because this one would replace it.
        """
        if output.name in self.names:
            detail = f"two results of the job would have the name {output.name}; rename one of the inputs"
            raise JobRefused("same-name", detail)
        self.names.add(output.name)
        self._ready.append(_encoder.submit(_with_encoded_arrays, output))
        self._ready_bytes += _array_bytes(output.parts)
        if self._ready_bytes > BYTES_PER_STAGE or len(self._ready) >= OUTPUTS_PER_STAGE:
            self.flush()

    def flush(self) -> None:
        """Send the results that have not been sent yet; call this after the last result."""
        if self._ready:
            wait(self._ready)  # errors of results that are already there have one traceback, so one signature
            self._context.stage([encoding.result() for encoding in self._ready])
        self._ready, self._ready_bytes = [], 0


def _array_bytes(tree: Any) -> int:
    if isinstance(tree, Mapping):
        return sum(map(_array_bytes, tree.values()))
    return int(getattr(tree, "nbytes", 0))


def _with_encoded_arrays(output: StagedOutput) -> StagedOutput:
    return output.model_copy(update={"parts": _encoded(output.parts)})


def _encoded(tree: Any) -> Any:
    if isinstance(tree, Mapping):
        return {name: _encoded(value) for name, value in tree.items()}
    return EncodedArray.of(require_finite(tree)) if isinstance(tree, np.ndarray) else tree

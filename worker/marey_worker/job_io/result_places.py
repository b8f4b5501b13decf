"""Places (folder and name) of a job's results: no two results may have the same place.

A result may have the place of an input only if it is made from this input, as its next revision.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from marey_motion.errors import MotionError
from marey_schemas.kinds import Kind
from marey_schemas.names import MAX_NAME_LENGTH
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import Context, JobRefused


class ResultPlaces:
    """Places (folder and name) of the inputs of one job, and of its results so far."""

    def __init__(self, context: Context) -> None:
        self._into = context.into
        self._inputs = {(pin.kind, pin.collection, pin.name) for many in context.inputs.values() for pin in many}
        self._taken: set[tuple[Kind, str, str]] = set()

    def take(self, kind: Kind, collection: str, *names: str) -> None:
        """Reserve names for results in the folder `collection`, which is below the target folder of the job.

        Raises `MotionError` if a name is too long or already reserved, or if the result of this name would replace an
        input. Then no name is reserved.
        """
        for name in names:
            self._require_free(kind, collection, name)
            if (kind, "/".join(filter(None, (self._into, collection))), name) in self._inputs:
                path = "/".join(filter(None, (self._into, collection, name)))
                raise MotionError(
                    f"the result would replace {path}, which is an input of the job; choose another folder or "
                    "another name for the results",
                    code="own-input",
                )
        self._taken |= {(kind, collection, name) for name in names}

    def keep(self, pin: PinnedInput) -> None:
        """Reserve the folder and name of an input for the result that is made from this input.

        Raises `MotionError` if this place is reserved for another result.
        """
        self._require_free(pin.kind, pin.collection, pin.name)
        self._taken.add((pin.kind, pin.collection, pin.name))

    def _require_free(self, kind: Kind, collection: str, name: str) -> None:
        if len(name) > MAX_NAME_LENGTH:
            raise MotionError(
                f"the result would have the name {name!r} of {len(name)} characters, but at most {MAX_NAME_LENGTH} are "
                "allowed; rename the input, or give a shorter suffix",
                code="name-too-long",
            )
        if (kind, collection, name) in self._taken:
            raise MotionError(
                f"another result of the job in the same folder has the name {name!r}; rename one of the inputs",
                code="same-name",
            )


def require_different(places: Iterable[tuple[str, str]]) -> None:
    """Raise `JobRefused` if two of the places (folder, name) are equal; call this before any computation."""
    counts = Counter(places)
    for (folder, name), count in counts.most_common(1):
        if count > 1:
            path = "/".join(filter(None, (folder, name)))
            raise JobRefused(
                "same-name",
                f"{count} results would have the path {path}; give each clip at one revision only, and rename clips of "
                "one folder whose results have the same name",
            )

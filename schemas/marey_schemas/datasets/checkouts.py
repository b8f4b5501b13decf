"""Checkouts of versions of datasets, or of parts of them, into folders, in requests and answers."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, StringConstraints

from marey_schemas.base import Answer, Request
from marey_schemas.datasets.commits import EntryPath
from marey_schemas.datasets.naming import MAIN, Version
from marey_schemas.queries.grammar import MOST_CHARACTERS

MOST_PATHS = 1000
"""Greatest number of paths in one selection."""
MOST_BYTES_OF_PATHS = 64 * 2**10
"""Greatest total size of the paths of a selection in UTF-8, in bytes, because lists of datasets contain the paths."""


def _not_too_long(paths: tuple[str, ...]) -> tuple[str, ...]:
    if sum(len(path.encode()) for path in paths) > MOST_BYTES_OF_PATHS:
        raise ValueError(
            f"the paths have more than {MOST_BYTES_OF_PATHS:,} bytes together; select folders, or use a query"
        )
    return paths


class CheckoutRequest(Request):
    """Request to bring the folder of a dataset to the state of a version, or of a part of the version.

    `query` and `paths` select the entries to check out; an entry must meet both. Without them, all entries are checked
    out.
    The folder remembers its selection: a commit of the folder changes only selected and new entries.
    """

    version: Version = MAIN
    query: Annotated[str, StringConstraints(min_length=1, max_length=MOST_CHARACTERS)] | None = Field(
        None,
        description="Query that selects entries, as in lists of items. The fields `path`, `folder`, `name` and "
        "`tag` refer to the entry in the folder of the dataset, all other fields to the content of "
        "the entry. Null: all entries.",
    )
    paths: Annotated[tuple[EntryPath, ...], AfterValidator(_not_too_long)] = Field(
        (), max_length=MOST_PATHS, description="Entries, or folders whose entries are selected; empty: all entries."
    )
    discard: bool = Field(
        False,
        description="Discard changes in the folder that no commit has recorded; otherwise, such changes are an error.",
    )

    @property
    def partial(self) -> bool:
        """Whether the request selects only some of the entries, by a query or by paths."""
        return self.query is not None or bool(self.paths)


class CheckoutAnswer(Answer):
    """Result of a checkout, with the numbers of entries that it changed in the folder of a dataset."""

    commit: str = Field(description="Digest of the commit that is checked out in the folder now.")
    taken: int | None = Field(
        None,
        description="Number of entries that the folder has now. Null: the server has an earlier version, "
        "which does not report it.",
    )
    entries: int | None = Field(
        None,
        description="Number of entries of the whole version, including those that were not selected. Null: the "
        "server has an earlier version, which does not report it.",
    )
    added: int
    removed: int
    moved: int
    changed: int

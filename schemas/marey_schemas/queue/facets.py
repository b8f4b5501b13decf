"""Facets: numbers with a name that jobs publish about revisions of their inputs, and that queries compare.

A facet belongs to the revision from which it was computed. Lists and queries use the facets of the newest revision of
an item, so a changed item has no facets until a job has measured it again.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Annotated

from pydantic import Field, StringConstraints

from marey_schemas.base import Request
from marey_schemas.names import form
from marey_schemas.sizes import MOST_INTEGER

MOST_FACETS = 16
"""Greatest number of facets that a job kind declares."""
MOST_MEASURED = 100_000
"""Greatest number of items about which one job publishes facets."""

_NAME_PATTERN = form(
    r"^[a-z][a-z0-9_]{0,63}$", "have at most 64 lower-case letters, digits and _, and begin with a letter"
)
FacetName = Annotated[str, StringConstraints(pattern=_NAME_PATTERN)]
FacetValue = Annotated[float, Field(allow_inf_nan=False)]


class ItemFacets(Request):
    """Facets of one item that a job measured, by name."""

    item: str = Field(max_length=64)
    revision: int = Field(ge=1, le=MOST_INTEGER)
    values: dict[FacetName, FacetValue] = Field(min_length=1, max_length=MOST_FACETS)


def is_facet_name(text: str) -> bool:
    """Return whether a text can be the name of a facet, so that a query can contain it."""
    return re.fullmatch(_NAME_PATTERN, text) is not None


def require_facet_names(kind: str, names: Collection[str]) -> None:
    """Raise `ValueError` if the job kind `kind` declares too many facets, or a name that a query cannot contain."""
    if len(names) > MOST_FACETS or not all(map(is_facet_name, names)):
        raise ValueError(
            f"job kind {kind}: declare at most {MOST_FACETS} facets, with names of at most 64 lower-case letters, "
            "digits and underscores that begin with a letter"
        )

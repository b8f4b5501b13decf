"""Kinds of items: their names in addresses, and the documents of their parts."""

from marey_schemas.documents.registry import SCHEMAS
from marey_schemas.kinds import PARTS, Kind


def test_every_part_of_every_kind_has_a_document_model() -> None:
    assert set(PARTS) == set(Kind)
    for kind, parts in PARTS.items():
        for name, part in parts.items():
            assert part.schema in SCHEMAS, f"{kind} part {name}: {part.schema} is missing in the registry of documents"


def test_the_plural_of_a_kind_leads_back_to_it() -> None:
    assert {kind: Kind.from_plural(kind.plural) for kind in Kind} == {kind: kind for kind in Kind}

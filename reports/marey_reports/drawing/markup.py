"""Creation of HTML in which MarkupSafe escapes every text that is not of the type `Html`."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TypeAlias

from markupsafe import Markup, escape

Html = Markup
"""Text that is already HTML. Only the functions of this module, and constants, make texts of this type."""

VOID = frozenset({"br", "hr", "img", "meta", "col"})
# Not allowed in HTML, or reordering what follows: names of clips come from outside.
_UNSEEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")


Content: TypeAlias = str | Html | Iterable["Content"] | None


def text(value: str) -> Html:
    """Escape a text for HTML; replace forbidden characters and controls of the writing direction with U+FFFD."""
    return escape(_UNSEEN.sub("\ufffd", value))


def coded(value: str) -> Html:
    """Make HTML of a text in which names between backticks, such as `skate_ratio`, become elements `code`."""
    pieces = value.split("`")
    if len(pieces) % 2 == 0:
        return text(value)
    return joined(element("code", piece) if place % 2 else piece for place, piece in enumerate(pieces))


def element(tag: str, /, *content: Content, **attributes: str | None) -> Html:
    """Make an HTML element.

    In the names of attributes, an underscore at the end is dropped, and other underscores are replaced with hyphens.
    Attributes that are None are omitted.
    """
    parts = [tag]
    for key, value in attributes.items():
        if value is not None:
            parts.append(f'{key.rstrip("_").replace("_", "-")}="{text(value)}"')
    opened = f"<{' '.join(parts)}>"
    return Html(opened if tag in VOID else f"{opened}{joined(content)}</{tag}>")


def joined(content: Iterable[Content]) -> Html:
    """Join pieces of content to HTML; pieces that are None are omitted."""
    return Html().join(_rendered(piece) for piece in content if piece is not None)


def _rendered(piece: Content) -> Html:
    if isinstance(piece, Html):
        return piece
    if isinstance(piece, str):
        return text(piece)
    return joined(piece or ())

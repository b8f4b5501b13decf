"""HTML that is right by construction: text is escaped unless it is `Html` already."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable

VOID = frozenset({"br", "hr", "img", "meta", "col"})
# Not allowed in HTML, or reordering what follows: names of clips come from outside.
_UNSEEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")


class Html(str):
    """Text that is HTML already; only this module and constants make it."""

    __slots__ = ()


Content = str | Html | Iterable["Content"] | None


def text(value: str) -> Html:
    """A text as HTML."""
    return Html(html.escape(_UNSEEN.sub("\ufffd", value), quote=True))


def element(tag: str, /, *content: Content, **attributes: str | None) -> Html:
    """An element. Underscores within names of attributes become hyphens, one at the end goes; None leaves it out."""
    parts = [tag]
    for key, value in attributes.items():
        if value is not None:
            parts.append(f'{key.rstrip("_").replace("_", "-")}="{text(value)}"')
    opened = f"<{' '.join(parts)}>"
    return Html(opened) if tag in VOID else Html(f"{opened}{joined(content)}</{tag}>")


def joined(content: Iterable[Content], between: str = "") -> Html:
    """Pieces as HTML; None is left out."""
    return Html(between.join(_rendered(piece) for piece in content if piece is not None))


def _rendered(piece: Content) -> str:
    if isinstance(piece, Html):
        return piece
    if isinstance(piece, str):
        return text(piece)
    return joined(piece or ())

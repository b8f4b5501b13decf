"""Media types of answers and bodies (RFC 9110, section 12)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from marey_schemas import problems
from marey_schemas.encoding import codecs
from marey_schemas.encoding.compression import ZSTD
from marey_server.errors import NotAcceptableProblem, UnauthenticatedProblem, UnsupportedMediaTypeProblem
from marey_server.motions.child import AnswerEncoding

MAX_RANGES = 64


@dataclass(frozen=True, slots=True)
class MediaType:
    """Media type of an answer. `form` is its name in ETags."""

    name: str
    form: str
    arrays: Literal["plain", "blocks"] = "plain"

    def __str__(self) -> str:
        return self.name if self.arrays == "plain" else f"{self.name}; arrays={self.arrays}"

    @property
    def encoding(self) -> AnswerEncoding:
        """This media type as an `AnswerEncoding`, which a child process gets with its task."""
        return AnswerEncoding(media_type=self.name, arrays=self.arrays)


JSON = MediaType(codecs.JSON, "json")
MSGPACK = MediaType(codecs.MSGPACK, "msgpack")
BSON = MediaType(codecs.BSON, "bson")
MSGPACK_BLOCKS = MediaType(codecs.MSGPACK, "msgpack-blocks", "blocks")
BSON_BLOCKS = MediaType(codecs.BSON, "bson-blocks", "blocks")

EVENT_STREAM = MediaType("text/event-stream", "events")

_PROBLEM, _PAGE = MediaType(problems.MEDIA_TYPE, "problem"), MediaType("text/html", "page")

MODEL_FORMS = (JSON, MSGPACK, BSON)
"""Media types of answers without arrays."""

DOCUMENT_FORMS = (JSON, MSGPACK, BSON, MSGPACK_BLOCKS, BSON_BLOCKS)
"""Media types of documents; `arrays=blocks` returns stored arrays without decoding them."""


@dataclass(frozen=True, slots=True)
class _Range:
    """Media range, one of the elements of an Accept header."""

    type: str
    subtype: str
    params: frozenset[tuple[str, str]]
    quality: float

    def specificity(self, offer: MediaType) -> int:
        """Return how specifically this range matches `offer`: a higher number is more specific, 0 is no match."""
        main, _, sub = offer.name.partition("/")
        held = {("arrays", offer.arrays)}
        if self.type == "*":
            return 1 if self.subtype == "*" and self.params <= held else 0
        if self.type != main or not self.params <= held:
            return 0
        if self.subtype == "*":
            return 2
        return 3 + len(self.params) if self.subtype == sub else 0


def choose(accept: str | None, offers: tuple[MediaType, ...]) -> MediaType:
    """Return the offered media type that the client prefers; of several equally preferred ones, the first.

    Without the header Accept, return the first. Raises `NotAcceptableProblem`, which lists the offered types, if the
    client accepts none of them.
    """
    chosen = _best(accept, offers) if accept else offers[0]
    if chosen is None:
        names = ", ".join(map(str, offers))
        raise NotAcceptableProblem(
            f"The Accept header allows no media type of this resource; this resource has only: {names}.",
            context={"offered": [str(offer) for offer in offers]},
        )
    return chosen


def prefers_page(accept: str | None) -> bool:
    """Return whether a client prefers an HTML page to a problem document, as browsers do."""
    return accept is not None and _best(accept, (_PROBLEM, JSON, _PAGE)) is _PAGE


@lru_cache(maxsize=512)
def _best(accept: str, offers: tuple[MediaType, ...]) -> MediaType | None:
    ranges = [found for text in accept.split(",")[:MAX_RANGES] if (found := _parse_range(text)) is not None]
    best: MediaType | None = None
    best_quality = 0.0
    for offer in offers:
        _, quality = max(((found.specificity(offer), found.quality) for found in ranges), default=(0, 0.0))
        named = any(found.specificity(offer) for found in ranges)
        if named and quality > best_quality:
            best, best_quality = offer, quality
    return best


def _parse_range(text: str) -> _Range | None:
    name, params = _split_parameters(text)
    main, slash, sub = name.partition("/")
    if not slash or not main or not sub:
        return None
    try:
        quality = float(params.pop("q", "1"))
    except ValueError:
        return None
    params.pop("charset", None)
    return _Range(main, sub, frozenset(params.items()), quality if 0 <= quality <= 1 else 0.0)


def _split_parameters(text: str) -> tuple[str, dict[str, str]]:
    name, *rest = text.split(";")
    params = {}
    for part in rest:
        key, _, value = part.partition("=")
        params[key.strip().lower()] = value.strip().strip('"').lower()
    return name.strip().lower(), params


def body_type(content_type: str | None, *, others: tuple[str, ...] = ()) -> str:
    """Return the media type of a body; JSON if the request names none. Errors also name the types in `others`.

    Raises `UnsupportedMediaTypeProblem` if documents are not read in this type, or if the text is not encoded as UTF-8.
    """
    if not content_type:
        return codecs.JSON
    name, params = _split_parameters(content_type)
    if name not in codecs.MEDIA_TYPES:
        accepted = [*others, *codecs.MEDIA_TYPES]
        raise UnsupportedMediaTypeProblem(
            f"The media type of the body is {name}; this request accepts only: {', '.join(accepted)}. Name the media "
            "type of the body in the header Content-Type.",
            context={"understood": accepted},
        )
    if params.get("charset", "utf-8") not in ("utf-8", "utf8", "us-ascii"):
        raise UnsupportedMediaTypeProblem(f"Text must be sent as UTF-8, not {params['charset']}.")
    return name


def is_compressed(content_encoding: str | None, *, may_be: bool) -> bool:
    """Return whether the body of a request is compressed with zstd.

    Raises `UnsupportedMediaTypeProblem` for any other compression. If `may_be` is false, raises it for zstd, too: a
    small compressed body could expand to a very large one.
    """
    coding = (content_encoding or "").strip().lower()
    if coding in ("", "identity"):
        return False
    if may_be and coding == ZSTD:
        return True
    accepted = "Only bodies that are compressed with zstd are" if may_be else "Compressed request bodies are not"
    raise UnsupportedMediaTypeProblem(
        f"{accepted} accepted; send the body without Content-Encoding: {content_encoding}."
    )


def accepts_zstd(accept_encoding: str | None) -> bool:
    """Return whether the header Accept-Encoding names zstd, and does not exclude it by the quality 0."""
    ranges = (_split_parameters(text) for text in (accept_encoding or "").split(",")[:MAX_RANGES])
    return any(name == ZSTD and params.get("q", "1").strip("0.") for name, params in ranges)


def bearer_token(authorization: str | None) -> str | None:
    """Return the token of an Authorization header, or None without a header.

    Raises `UnauthenticatedProblem` if the header is malformed.
    """
    if authorization is None:
        return None
    scheme, _, token = authorization.strip().partition(" ")
    if scheme.lower() != "bearer" or not token.strip() or len(token) > 1024:
        raise UnauthenticatedProblem("The Authorization header must read: Bearer <token>.", code="bad-authorization")
    return token.strip()

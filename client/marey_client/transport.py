"""HTTP connections to a server: requests with authentication and retries; answers as models or errors."""

from __future__ import annotations

import logging
import os
import ssl
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cached_property
from typing import Any, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel, ValidationError

from marey_client.asynchronous.interruption import note_at_hand, stop_if_interrupted
from marey_client.credentials import BearerToken, TokenFile, require_address, resolve, trusted_authorities
from marey_client.errors import BadArgument, ConnectionClosed, RequestFailed, UnexpectedAnswer, Unreachable, error_of
from marey_client.retries import BUSY_STATUSES, NEVER_ARRIVED, Retries, retry_after_s
from marey_client.tracing import TracedRequest, calling
from marey_client.unanswered import explain_silence, media_type_of, not_of_marey, require_marey, server_of
from marey_schemas.address import API
from marey_schemas.encoding.codecs import JSON, CodecError, decode_tree, encode_tree
from marey_schemas.encoding.compression import LEAST_BYTES_COMPRESSED, ZSTD, compress
from marey_schemas.problems import MEDIA_TYPE as PROBLEM
from marey_schemas.problems import Problem
from marey_schemas.validation.reasons import first_reason

Model = TypeVar("Model", bound=BaseModel)
T = TypeVar("T")
Method = TypeVar("Method", bound=Callable[..., Any])
Params = Mapping[str, str | int | float | bool | None]

BLOCKS = "application/msgpack; arrays=blocks"
UNSUPPORTED = 415
"""Status with which servers of earlier versions refuse compressed bodies."""
LIMITS = httpx.Limits(max_connections=32, max_keepalive_connections=16)

TRIES_TO_REACH = 3
"""Number of attempts for the first request: a server that has never answered is probably not running."""

_DOTS = frozenset((".", ".."))
_BROKEN = (httpx.NetworkError, httpx.RemoteProtocolError)
"""Failures of connections to a program that listens; `httpx.NetworkError` includes failures to connect."""

log = logging.getLogger(__name__)


def sends_nothing(method: Method) -> Method:
    """Mark a method of the SDK that sends no request, so that the async client need not wait for it."""
    return method


class _TlsOnFirstUse(httpx.BaseTransport):
    """TLS connections whose certificates are read by the first request that uses TLS, because this takes 25 ms.

    With a server without TLS, only requests that the server redirects to object storage use TLS.
    """

    @cached_property
    def _ready(self) -> httpx.HTTPTransport:
        return httpx.HTTPTransport(verify=trusted_authorities(), limits=LIMITS, trust_env=False)

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        return self._ready.handle_request(request)

    def close(self) -> None:
        if "_ready" in self.__dict__:
            self._ready.close()


class Transport:
    """HTTP connections to one server. May be used by several threads."""

    def __init__(
        self,
        url: str,
        token: str | TokenFile | None = None,
        *,
        retries: Retries | None = None,
        timeout_s: float = 60.0,
        http: httpx.BaseTransport | None = None,
    ) -> None:
        require_address(url)
        self.url = url.rstrip("/")
        self.retries = retries or Retries()
        self._reached, self._refuses_zstd = threading.Event(), threading.Event()
        self._auth = BearerToken(token) if token else None
        self._connections = _Connections(self.url, timeout_s, http)

    def __reduce__(self) -> tuple[Any, ...]:
        return _connected_again, (self.url,)  # a pickle must not contain a token

    @property
    def _client(self) -> httpx.Client:
        return self._connections.client()

    @property
    def anonymous(self) -> bool:
        """Whether requests are sent without a token."""
        return self._auth is None

    def with_token(self, token: str, *, retries: Retries | None = None) -> Transport:
        """Return a transport that sends another token over the same connections.

        Closing one of the two transports closes the connections of both.
        """
        other = self.with_retries(retries or self.retries)
        other._auth = BearerToken(token)
        return other

    def with_present_token(self) -> Transport:
        """Return a transport with the same connections that always sends the token that is valid now.

        If the token was read from a file, later changes of this file have no effect on the new transport.
        """
        return self if self._auth is None else self.with_token(self._auth.token)

    def has_token_of(self, other: Transport) -> bool:
        """Return whether this transport and `other` send the same token at present."""
        return (self._auth and self._auth.token) == (other._auth and other._auth.token)

    def with_retries(self, retries: Retries) -> Transport:
        """Return a transport with the same connections and token, and with other limits of retries."""
        other = object.__new__(Transport)
        other.__dict__ |= self.__dict__
        other.retries = retries
        return other

    def close(self) -> None:
        """Close every connection to the server."""
        self._connections.close()

    # -- models --------------------------------------------------------------------------------------------------------

    def get(
        self,
        answer: type[Model],
        path: str,
        params: Params | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> Model:
        """Request a JSON document by GET, and return it as an instance of `answer`."""
        return read_model(answer, self.send("GET", path, params=params, headers=headers))

    def post(self, answer: type[Model], path: str, body: BaseModel | None = None, **options: Any) -> Model:
        """Send a JSON document by POST; return the document in the answer. `options` are those of `send`."""
        return read_model(answer, self.send("POST", path, content=as_json(body), **options))

    def send(
        self,
        method: str,
        path: str,
        *,
        params: Params | None = None,
        content: bytes | Callable[[], Iterable[bytes]] | None = None,
        media_type: str = JSON,
        headers: Mapping[str, str] | None = None,
        repeatable: bool | None = None,
        timeout_s: float | None = None,
    ) -> httpx.Response:
        """Send a request, if necessary several times, and return the complete answer.

        If `repeatable` is False, the request is not sent again after its connection broke. The default is False for
        PUT, PATCH and DELETE requests that have the header `If-Match`, and True for all other requests. If `repeatable`
        is not given, POST requests get an idempotency key. To stream `content`, give a function that returns a new
        iterable of bytes for each try.

        Raises `RequestFailed` if the server answers with an error, `Unreachable` if there is no answer.
        """
        with calling(method) as call:
            return self._send(
                call, method, path, params=params, content=content, media_type=media_type, headers=headers,
                repeatable=repeatable, timeout_s=timeout_s,
            )  # fmt: skip

    def _send(
        self,
        call: TracedRequest,
        method: str,
        path: str,
        *,
        params: Params | None,
        content: bytes | Callable[[], Iterable[bytes]] | None,
        media_type: str,
        headers: Mapping[str, str] | None,
        repeatable: bool | None,
        timeout_s: float | None,
    ) -> httpx.Response:
        sent_headers = {"Accept": JSON, **call.headers, **(headers or {})}
        if content is not None:
            sent_headers.setdefault("Content-Type", media_type)
        if repeatable is None:
            repeatable = method in ("GET", "HEAD", "POST") or "If-Match" not in sent_headers
            if method == "POST":
                sent_headers.setdefault("Idempotency-Key", uuid.uuid4().hex)

        def once() -> httpx.Response:
            call.note_try()
            response = self._client.request(
                method,
                _quoted(path),
                params=_present(params),
                content=content() if callable(content) else content,
                headers=sent_headers,
                auth=self._auth,
                timeout=httpx.Timeout(timeout_s, connect=10.0) if timeout_s else httpx.USE_CLIENT_DEFAULT,
            )
            call.note_answer(response.status_code)
            raise_for_problem(response)
            require_marey(response)
            return response

        return self.repeat(once, repeatable=repeatable, what=f"{method} {path}")

    def repeat(self, once: Callable[[], T], *, repeatable: bool, what: str) -> T:
        """Call `once` until it succeeds, at most `retries.tries` times, and return its result.

        Errors that a retry cannot solve are raised at once; if `repeatable` is False, also errors of a connection that
        broke when the server may have received the request. `what` names the request in the log.
        """
        started = time.monotonic()
        for tried in range(1, self.retries.tries + 1):
            stop_if_interrupted()
            note_at_hand(0)
            try:
                answer = once()
                self._reached.set()
                return answer
            except RequestFailed as error:
                self._reached.set()
                failure: Exception = error
                again, wait_s = error.problem.status in BUSY_STATUSES, error.retry_after_s
            except httpx.TransportError as error:
                failure = Unreachable(f"{self.url} does not answer: {explain_silence(self.url, error)}")
                failure.__cause__ = error
                arrived = not isinstance(error, NEVER_ARRIVED)
                if arrived and isinstance(error, _BROKEN):  # also by a server that stops during the request
                    self._reached.set()
                again, wait_s = repeatable or not arrived, None
            delay_s = self.retries.delay_s(tried, wait_s)
            late = time.monotonic() - started + delay_s > self.retries.total_s
            most = self.retries.tries if self._reached.is_set() else min(self.retries.tries, TRIES_TO_REACH)
            if not again or late or tried >= most:
                raise failure
            log.info("%s: %s; trying again in %.1f s", what, failure, delay_s)
            busy = isinstance(failure, RequestFailed)
            self.retries.report_wait(self.url, tried, time.monotonic() - started, busy=busy)
            self.retries.sleep(delay_s)
        raise AssertionError("the loop over the tries ended without a result")

    def send_compressed(
        self,
        method: str,
        path: str,
        *,
        content: bytes | None,
        media_type: str = JSON,
        headers: Mapping[str, str] | None = None,
    ) -> httpx.Response:
        """Send a body compressed by zstd, for operations that accept this; send it plain if the server refuses zstd."""
        if content is not None and len(content) >= LEAST_BYTES_COMPRESSED and not self._refuses_zstd.is_set():
            coded = {"Content-Encoding": ZSTD, **(headers or {})}
            try:
                return self.send(method, path, content=compress(content), media_type=media_type, headers=coded)
            except RequestFailed as error:
                if error.problem.status != UNSUPPORTED:
                    raise
                self._refuses_zstd.set()
        return self.send(method, path, content=content, media_type=media_type, headers=headers)

    # -- documents with arrays -----------------------------------------------------------------------------------------

    def get_tree(self, path: str, params: Params | None = None) -> tuple[Any, str | None]:
        """Request a document by GET; return it with numpy arrays, and its ETag or None."""
        response = self.send("GET", path, params=params, headers={"Accept": BLOCKS})
        return read_tree(response), response.headers.get("ETag")

    def send_tree(self, method: str, path: str, tree: Any, **options: Any) -> httpx.Response:
        """Send a document as MessagePack, with its numpy arrays in the block encoding."""
        body = encode_tree(tree, "application/msgpack", arrays="blocks")
        return self.send(method, path, content=body, media_type=BLOCKS, **options)

    # -- bytes ---------------------------------------------------------------------------------------------------------

    @contextmanager
    def stream(
        self, path: str, *, params: Params | None = None, headers: Mapping[str, str] | None = None
    ) -> Iterator[httpx.Response]:
        """Request bytes by GET, and yield the answer while its body still arrives. The caller handles retries.

        If the server redirects to its object storage, the bytes are read there, and httpx does not send the token.
        """
        with (
            calling("GET") as call,
            self._client.stream(
                "GET",
                _quoted(path),
                params=_present(params),
                headers={"Accept": "*/*", **call.headers, **(headers or {})},
                auth=self._auth,
                follow_redirects=True,
            ) as response,
        ):
            call.note_answer(response.status_code)
            if response.status_code >= 400:
                response.read()
            raise_for_problem(response)
            yield response


def _connected_again(url: str) -> Transport:
    """Return a transport for `url` with the token that the command line would use; called when unpickling."""
    return Transport(url, resolve(url).bearer)


class _Connections:
    """Connections to a server. A forked process opens connections of its own instead of sharing those of its parent."""

    def __init__(self, url: str, timeout_s: float, http: httpx.BaseTransport | None) -> None:
        self._url = url
        self._timeout_s = timeout_s
        self._http = http
        self._opened = (os.getpid(), self._open())

    def client(self) -> httpx.Client:
        """Return the HTTP client of this process. Raises `ConnectionClosed` if it was closed."""
        process, client = self._opened
        if process != os.getpid():
            client = self._open()
            self._opened = (os.getpid(), client)
        if client.is_closed:
            raise ConnectionClosed
        return client

    def close(self) -> None:
        """Close the connections of this process; those of the process that forked it stay open."""
        process, client = self._opened
        if process == os.getpid():
            client.close()

    def _open(self) -> httpx.Client:
        return httpx.Client(
            base_url=self._url + API,
            timeout=httpx.Timeout(self._timeout_s, connect=10.0),
            limits=LIMITS,
            headers={"User-Agent": "marey-client"},
            verify=ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT),  # trusts nobody: only requests without TLS use it
            mounts=None if self._http else {"https://": _TlsOnFirstUse()},
            transport=self._http,
            trust_env=False,  # no proxy and no .netrc comes between a token and its server
        )


def named_path(path: str, name: str) -> str:
    """Return the path of the resource with a name or an id below `path`.

    Raises `BadArgument` if `name` is empty or contains a slash: the request would reach another resource, such as the
    identities of a user instead of the user.
    """
    if not name or "/" in name:
        raise BadArgument(f"{name!r} is neither a name nor an id; these are not empty and contain no slash")
    return f"{path}/{name}"


def _quoted(path: str) -> str:
    """Return a path with its names percent-encoded, because names may contain any character.

    Raises `BadArgument` if a name is `.` or `..`: HTTP clients and proxies resolve such names, even percent-encoded
    ones, so the request would reach another address, such as that of the project instead of that of a member.
    """
    if not _DOTS.isdisjoint(path.split("/")):
        raise BadArgument(f"{path}: a name cannot be . or ..")
    return quote(path, safe="/:@!$&'()*+,;=~")


def as_json(model: BaseModel | None) -> bytes | None:
    """Return the fields of `model` that were set, as JSON with secrets in plain text; None if there is no model."""
    if model is None:
        return None
    return encode_tree(_revealed(model.model_dump(exclude_unset=True, by_alias=True)), JSON)


def _revealed(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _revealed(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_revealed(item) for item in value]
    return value.get_secret_value() if hasattr(value, "get_secret_value") else value


def read_model(answer: type[Model], response: httpx.Response) -> Model:
    """Parse the body of `response` as a model. Raises `UnexpectedAnswer` if the body is not valid for the model."""
    if response.status_code == 204:
        raise UnexpectedAnswer(
            f"{response.request.method} {response.request.url.path}: the server made the change, but does not show the "
            "result, because the token lacks the scope read; use a token with this scope"
        )
    try:
        return answer.model_validate_json(response.content)
    except ValidationError as error:
        if media_type_of(response) not in ("", JSON):
            raise UnexpectedAnswer(not_of_marey(response)) from error
        raise UnexpectedAnswer(
            f"{response.request.method} {response.request.url.path}: this client cannot read the server's answer "
            f"({first_reason(error, answer)}); client and server have different versions: `marey doctor` shows both; "
            "update the older one"
        ) from error


def read_tree(response: httpx.Response) -> Any:
    """Return the document in the body of `response`, with numpy arrays."""
    try:
        return decode_tree(response.content, media_type_of(response))
    except CodecError as error:
        raise UnexpectedAnswer(
            f"{response.request.url.path}: this client cannot decode the server's answer ({error}); update the older "
            "of the two: `marey --version` shows the version of the client"
        ) from error


def raise_for_problem(response: httpx.Response) -> None:
    """Raise an error if the status of an answer is 400 or higher."""
    if response.status_code < 400:
        return
    circumstances: dict[str, Any] = {
        "retry_after_s": retry_after_s(response),
        "anonymous": "Authorization" not in response.request.headers,
        "server": server_of(response),
    }
    if response.headers.get("Content-Type", "").startswith(PROBLEM) and response.content:
        with suppress(ValidationError):  # others than Marey answer with problems, too
            raise error_of(Problem.model_validate_json(response.content), **circumstances)
    problem = Problem(
        type="about:blank",
        title=response.reason_phrase,
        status=response.status_code,
        detail=not_of_marey(response),
        instance=response.headers.get("X-Request-Id", ""),
        code=f"http-{response.status_code}",
    )
    raise error_of(problem, **circumstances)


def _present(params: Params | None) -> dict[str, str] | None:
    """Return the query parameters that are not None as texts; booleans become `true` and `false`."""
    if not params:
        return None
    return {
        name: str(value).lower() if isinstance(value, bool) else str(value)
        for name, value in params.items()
        if value is not None
    }

"""Lookup of the address of the server and of the token that clients send.

The token is taken from the first of these places that has one: a file named on the command line, `MAREY_TOKEN`, the
file written by `marey login`, and `admin.token` in the data folder of a server on this machine.
"""

from __future__ import annotations

import json
import logging
import os
import re
import ssl
import tempfile
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import certifi

from marey_client.errors import BadAddress, BadCredentialFile, BadToken
from marey_schemas.address import (
    ADMIN_TOKEN_FILE,
    DEFAULT_DATA,
    DEFAULT_HOST,
    DEFAULT_PORT,
    SERVER_VARIABLES,
    SETTINGS_FILE,
)

if TYPE_CHECKING:
    import httpx  # takes long to load; completion in a shell needs credentials only

DEFAULT_URL = f"http://{DEFAULT_HOST}:{DEFAULT_PORT}"
log = logging.getLogger(__name__)

LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})
_PLAIN_ADDRESS = re.compile(
    r"https?://(127\.0\.0\.1|(?![0-9.]+[:/]|[0-9.]+$)[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?)(:[1-9][0-9]{0,3})?"
    r"(/[A-Za-z0-9._/-]*)?"
)
"""Pattern of addresses that are certainly valid, with a host name or 127.0.0.1; other addresses are parsed."""


class TokenFile:
    """File that contains a token; the file is read again whenever it has changed.

    A program therefore continues to work after its token was rotated. If the changed file cannot be read, or contains
    no token, the token that was read last stays in use.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._seen = self._state()
        self._token = as_token(read_secret(path))

    @property
    def token(self) -> str:
        """The token that the file contains now."""
        if (state := self._state()) != self._seen:
            self._seen = state
            try:
                self._token = as_token(read_secret(self.path))
            except (BadCredentialFile, BadToken) as error:
                log.warning("%s; the token that was read before stays in use", error)
        return self._token

    def _state(self) -> tuple[int, int, int] | None:
        try:
            found = self.path.stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_ino, found.st_size


def trusted_authorities() -> ssl.SSLContext:
    """Return a TLS context that trusts public certificate authorities and those of this machine and `SSL_CERT_FILE`."""
    context = ssl.create_default_context(cafile=certifi.where())
    context.load_default_certs()
    return context


class BearerToken:
    """Authentication for httpx: adds the token to each request. Its `repr` does not show the token."""

    def __init__(self, token: str | TokenFile) -> None:
        self._source = token if isinstance(token, TokenFile) else as_token(token)

    @property
    def token(self) -> str:
        """The token to send now; a `TokenFile` may have read a new one."""
        return self._source.token if isinstance(self._source, TokenFile) else self._source

    def __call__(self, request: httpx.Request) -> httpx.Request:
        """Set the header `Authorization` of a request to the current token."""
        request.headers["Authorization"] = f"Bearer {self.token}"
        return request

    def __repr__(self) -> str:
        return "BearerToken(...)"


@dataclass(frozen=True)
class Credential:
    """Address of a server, the token for this server, and the place of the token."""

    url: str
    token: str | None = field(repr=False)
    origin: str = ""
    """Text that names the place where the token was found, such as a file, for messages."""
    file: Path | None = None
    """File that contains only the token; None if the token does not come from such a file."""
    logins: Path | None = None
    """File of stored logins in which the token was found, or in which `resolve_other` found none; otherwise None."""

    @property
    def bearer(self) -> str | TokenFile | None:
        """The token, or None; if `file` is given, a `TokenFile`, which is read again whenever the file changes."""
        return self.token if self.file is None else TokenFile(self.file)


def resolve(
    url: str | None = None, token_file: Path | None = None, environment: Mapping[str, str] | None = None
) -> Credential:
    """Return the server and the token, from arguments, environment variables, a stored login or a local server.

    The token is None if there is none. Raises `BadAddress`, and `BadCredentialFile` if a file with tokens is not valid.
    """
    environment = os.environ if environment is None else environment
    stored = read_logins(logins_path(environment))
    by_variable = next(filter(None, map(environment.get, SERVER_VARIABLES)), None)
    chosen = (url or by_variable or stored.default or DEFAULT_URL).rstrip("/")
    require_address(chosen)
    if token_file is not None:
        return _from_file(chosen, token_file)
    if token := environment.get("MAREY_TOKEN"):
        return Credential(chosen, token, "the variable MAREY_TOKEN")
    if token := stored.tokens.get(chosen):
        path = logins_path(environment)
        return Credential(chosen, token, f"marey login, which keeps it in {path}", logins=path)
    file = _local_token_file(chosen, environment)
    return Credential(chosen, None) if file is None else _from_file(chosen, file)


def resolve_other(url: str, token_file: Path | None = None, environment: Mapping[str, str] | None = None) -> Credential:
    """Return the token for a second server, from a file or from `marey login`.

    Tokens in the environment or in the data folder are for the first server, and are never sent to another server.
    """
    chosen = url.rstrip("/")
    require_address(chosen)
    if token_file is not None:
        return _from_file(chosen, token_file)
    path = logins_path(os.environ if environment is None else environment)
    token = read_logins(path).tokens.get(chosen)
    return Credential(chosen, token, "" if token is None else f"marey login, which keeps it in {path}", logins=path)


def _from_file(url: str, file: Path) -> Credential:
    return Credential(url, read_secret(file), str(file), file=file)


def require_address(url: str) -> None:
    """Raise `BadAddress` if `url` is not the address of a server, or contains more than scheme, host, port and path."""
    if _PLAIN_ADDRESS.fullmatch(url):
        return  # without httpx, which takes long to load, and which shell completion does not need
    import httpx

    try:
        parts, _ = urlsplit(url), httpx.URL(url)
        named = "@" in parts.netloc
        fits = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except (httpx.InvalidURL, ValueError):
        fits = named = False
    if named or ("@" in url and not fits):  # errors and logs would show the password
        raise BadAddress(
            f"the address of a server must not contain a user name or a password; write it like {DEFAULT_URL}, and log "
            "in with `marey login`"
        )
    if not fits or "?" in url or "#" in url:
        raise BadAddress(f"{url!r} is not the address of a server; write it like {DEFAULT_URL}")


def as_token(text: str) -> str:
    """Return `text` without leading and trailing white space. Raises `BadToken`, whose message omits the text."""
    token = text.strip()
    if not token or not token.isascii() or not token.isprintable() or set(token) & set(" \"'<>"):
        raise BadToken(
            "the text given is not a token: a token is one word of letters, digits and _, without quotes, and without "
            "the word Bearer before it"
        )
    return token


def read_secret(path: Path) -> str:
    """Return the token in a file.

    Raises `BadCredentialFile` if the file cannot be read, if it does not contain exactly one token, or if other users
    can read it.
    """
    try:
        mode = path.stat().st_mode
        text = path.read_text(encoding="ascii").strip()
    except UnicodeDecodeError as error:
        raise BadCredentialFile(
            f"the file {path} contains no token: a token has only ASCII letters, digits and _"
        ) from error
    except OSError as error:
        raise BadCredentialFile(f"{path} cannot be read: {error.strerror}") from error
    if os.name == "posix" and mode & _forbidden_rights(path):
        raise BadCredentialFile(
            f"the token file {path} can be read by other users of this machine; run: chmod 600 {path}"
        )
    if not text or any(character.isspace() for character in text):
        raise BadCredentialFile(f"the token file {path} must contain one token and nothing else")
    return text


def _forbidden_rights(path: Path) -> int:
    """Return the mode bits that a token file must not have: access for group and others.

    Files in the folder `CREDENTIALS_DIRECTORY` may be readable by the group. systemd gives a service read access to its
    credentials by an access control list, whose mask appears in the mode as read access of the group. In a pod,
    Kubernetes gives read access to a group that no other process has; the manifest of the pod sets the variable.
    """
    credentials = os.environ.get("CREDENTIALS_DIRECTORY")
    return 0o037 if credentials and path.absolute().parent == Path(credentials) else 0o077


# -- what `marey login` stores --


@dataclass(frozen=True)
class Logins:
    """Stored logins: the token for each server, by its address, and the default server."""

    default: str | None = None
    tokens: Mapping[str, str] = field(default_factory=dict, repr=False)


def logins_path(environment: Mapping[str, str]) -> Path:
    """Return the path of the file of stored logins, below `XDG_CONFIG_HOME` or `~/.config`."""
    base = environment.get("XDG_CONFIG_HOME") or str(Path(environment.get("HOME") or Path.home()) / ".config")
    return Path(base) / "marey" / "credentials.json"


def read_logins(path: Path) -> Logins:
    """Return the stored logins, none if there is no file. Raises `BadCredentialFile` if the file is damaged."""
    if not path.exists():
        return Logins()
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return Logins(content["default"], dict(content["tokens"]))
    except (ValueError, KeyError, TypeError) as error:
        raise BadCredentialFile(f"the file of logins {path} is damaged; remove it and log in again") from error


def store_login(path: Path, url: str, token: str) -> None:
    """Store a token for a server, and the server as the default. Only this user can read the file."""
    tokens = {**read_logins(path).tokens, url: token}
    _write_logins(path, Logins(url, tokens))


def forget_login(path: Path, url: str) -> bool:
    """Delete the stored token for a server from the file of logins; return False if none was stored."""
    stored = read_logins(path)
    if url not in stored.tokens:
        return False
    tokens = {known: token for known, token in stored.tokens.items() if known != url}
    _write_logins(path, Logins(None if stored.default == url else stored.default, tokens))
    return True


def replace_token(credential: Credential, token: str) -> None:
    """Replace a token in its file, in one step. Raises `BadCredentialFile` if the token does not come from a file."""
    if credential.file is not None:
        write_private(credential.file, f"{token}\n")
    elif credential.logins is not None:
        stored = read_logins(credential.logins)
        _write_logins(credential.logins, Logins(stored.default, {**stored.tokens, credential.url: token}))
    else:
        raise BadCredentialFile(
            f"the token comes from {credential.origin}, where the command cannot store a new token; put the token "
            "into a file, and name it with --token-file"
        )


def _write_logins(path: Path, logins: Logins) -> None:
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    write_private(path, json.dumps({"default": logins.default, "tokens": dict(logins.tokens)}, indent=1))


def write_private(path: Path, text: str) -> None:
    """Write a file that only its owner can read, in one step; a file that exists keeps its owner."""
    path = path.resolve()  # a link stays a link
    handle, name = tempfile.mkstemp(dir=path.parent)  # mode 0600
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            _keep_owner(file.fileno(), path)
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink()  # it may hold tokens
        raise


def _keep_owner(handle: int, path: Path) -> None:
    """Give a new file the owner of the file that it will replace, for example if root rotates a service's token."""
    if os.name != "posix" or not path.exists():
        return
    before, now = path.stat(), os.fstat(handle)
    if (before.st_uid, before.st_gid) != (now.st_uid, now.st_gid):
        os.fchown(handle, before.st_uid, before.st_gid)


def _local_token_file(url: str, environment: Mapping[str, str]) -> Path | None:
    """Return the path of the administrator's token file of a server on this machine; None if it cannot be read."""
    if urlsplit(url).hostname not in LOOPBACK:
        return None
    path = Path(environment.get("MAREY_DATA") or _configured_data() or DEFAULT_DATA) / ADMIN_TOKEN_FILE
    return path if path.is_file() and os.access(path, os.R_OK) else None


def _configured_data() -> str | None:
    """Return the data folder in `marey.toml` of the working directory, which a server started here would use."""
    try:
        data = tomllib.loads(Path(SETTINGS_FILE).read_text(encoding="utf-8")).get("data")
    except (OSError, ValueError):  # a server would tell what is wrong with it
        return None
    return data if isinstance(data, str) else None

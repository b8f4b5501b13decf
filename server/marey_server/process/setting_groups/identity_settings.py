"""Settings of the sign-in with an identity provider."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit

from pydantic import Field, ValidationInfo, field_validator
from pydantic_settings import BaseSettings

from marey_schemas.sizes import LOGIN_DAYS, LONGEST_LOGIN_DAYS
from marey_server.access.network_addresses import is_protected
from marey_server.process.secret_files import read_secret


class IdentitySettings(BaseSettings):
    """Settings with which users sign in at an identity provider (OpenID Connect)."""

    public_url: str | None = Field(
        None,
        max_length=512,
        description="Address at which browsers reach the server, such as https://marey.lab.example. Reports show "
        "it in their heads, and oidc_issuer needs it.",
    )
    oidc_issuer: str | None = Field(
        None,
        max_length=512,
        description="Address of the identity provider (OpenID Connect), exactly as its discovery document names it, "
        "such as https://login.lab.example/realms/lab. Absent: users sign in with passwords only.",
    )
    oidc_client_id: str | None = Field(
        None,
        validate_default=True,
        max_length=255,
        description="Name under which the server is registered at the identity provider.",
    )
    oidc_client_secret_file: Path | None = Field(
        None,
        description="File that contains the secret of oidc_client_id and nothing else. Absent: the server is "
        "registered as a public client, without a secret.",
    )
    oidc_scopes: tuple[str, ...] = Field(
        ("openid", "profile", "email"),
        max_length=16,
        description="Scopes that the server requests; openid must be one of them.",
    )
    oidc_name_claim: str = Field(
        "preferred_username",
        min_length=1,
        max_length=255,
        description="Claim from which the name of a new user is made: its part before @, in lower case. Names never "
        "decide who somebody is.",
    )
    oidc_allowed_claim: str | None = Field(
        None,
        min_length=1,
        max_length=255,
        description="Claim with the groups or the domain of a person, such as groups or hd. Absent: everybody with a "
        "linked user may sign in.",
    )
    oidc_allowed_values: tuple[str, ...] = Field(
        (), description="Values of oidc_allowed_claim of which a person must have at least one to sign in."
    )
    oidc_creates_users: bool = Field(
        False,
        description="Create a user for each person who signs in and is not linked with a user. If false, an "
        "administrator links each person.",
    )
    oidc_longest_days: int = Field(
        LOGIN_DAYS,
        ge=1,
        le=LONGEST_LOGIN_DAYS,
        description="Greatest number of days for which a sign-in is valid. Until then, the identity provider is not "
        "asked again.",
    )
    oidc_leeway_s: int = Field(
        60,
        ge=0,
        le=300,
        description="Seconds by which the clocks of this server and of the identity provider may differ.",
    )

    @field_validator("public_url", "oidc_issuer")
    @classmethod
    def _check_address(cls, address: str | None) -> str | None:
        if address is None:
            return None
        parts = urlsplit(address)
        if not is_protected(address) or parts.query or parts.fragment or "@" in parts.netloc:
            raise ValueError(
                "the address must begin with https:// (http:// only for this machine, such as http://127.0.0.1:8000) "
                "and must not contain a user, ? or #"
            )
        return address

    @field_validator("oidc_issuer")
    @classmethod
    def _check_issuer(cls, issuer: str | None, others: ValidationInfo) -> str | None:
        if issuer is not None and others.data.get("public_url") is None:
            raise ValueError("oidc_issuer needs the setting public_url")
        return issuer

    @field_validator("oidc_client_id")
    @classmethod
    def _check_client_id(cls, client_id: str | None, others: ValidationInfo) -> str | None:
        if client_id is None and others.data.get("oidc_issuer") is not None:
            raise ValueError("oidc_issuer needs the setting oidc_client_id")
        if client_id is not None and not (client_id and client_id.isascii() and client_id.isprintable()):
            raise ValueError("the client id must consist of printable ASCII characters")
        return client_id

    @field_validator("oidc_client_secret_file")
    @classmethod
    def _check_secret_file(cls, file: Path | None) -> Path | None:
        if file is not None and not read_secret(file):
            raise ValueError(f"{file} is empty, but must contain the secret of oidc_client_id")
        return file

    @field_validator("oidc_scopes")
    @classmethod
    def _check_scopes(cls, scopes: tuple[str, ...]) -> tuple[str, ...]:
        if "openid" not in scopes or not all(
            one.isascii() and one.isprintable() and one and " " not in one for one in scopes
        ):
            raise ValueError("the scopes must be words, and one of them must be openid")
        return scopes

    @field_validator("oidc_allowed_values")
    @classmethod
    def _check_allowed_values(cls, values: tuple[str, ...], others: ValidationInfo) -> tuple[str, ...]:
        if bool(values) != (others.data.get("oidc_allowed_claim") is not None):
            raise ValueError("oidc_allowed_claim and oidc_allowed_values are needed together")
        return values

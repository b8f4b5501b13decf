"""Users, tokens and members."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from marey_client.paging import pages
from marey_client.transport import Transport, as_json, read_model
from marey_schemas.access import (
    Member,
    MemberChange,
    NewToken,
    Role,
    Token,
    TokenCreate,
    User,
    UserChange,
    UserCreate,
)

ANY_STATE = {"If-Match": "*"}
"""A change that replaces whatever stands there."""


@dataclass(frozen=True)
class Users:
    """Who can sign in; for administrators."""

    transport: Transport

    def list(self) -> Iterator[User]:
        """Every user."""
        return pages(self.transport, User, "/users")

    def get(self, name: str) -> User:
        """One user."""
        return self.transport.get(User, f"/users/{name}")

    def create(self, user: UserCreate) -> User:
        """Make a user."""
        return self.transport.post(User, "/users", user, repeatable=False)

    def change(self, name: str, change: UserChange) -> User:
        """Change a user; one's own password needs the current one."""
        return read_model(
            User, self.transport.send("PATCH", f"/users/{name}", content=as_json(change), headers=ANY_STATE)
        )

    def disable(self, name: str) -> None:
        """Take a user's access away; what they made stays."""
        self.transport.send("DELETE", f"/users/{name}", headers=ANY_STATE)

    def enable(self, name: str) -> User:
        """Let a user who was disabled in again, with the password and the tokens they had."""
        return self.change(name, UserChange(disabled=False))


@dataclass(frozen=True)
class Tokens:
    """The caller's tokens."""

    transport: Transport

    def list(self) -> Iterator[Token]:
        """Every token, without secrets."""
        return pages(self.transport, Token, "/tokens")

    def create(self, token: TokenCreate) -> NewToken:
        """Make a token; its secret is in the answer and never shown again."""
        return self.transport.post(NewToken, "/tokens", token, repeatable=False)

    def revoke(self, token_id: str) -> None:
        """Make a token useless, now."""
        self.transport.send("DELETE", f"/tokens/{token_id}")


@dataclass(frozen=True)
class Members:
    """Who may do what in a project."""

    transport: Transport
    project: str

    def list(self) -> Iterator[Member]:
        """Every member with their role."""
        return pages(self.transport, Member, f"/projects/{self.project}/members")

    def put(self, user: str, role: Role) -> Member:
        """Give a user a role, whatever they had before."""
        return read_model(
            Member,
            self.transport.send(
                "PUT",
                f"/projects/{self.project}/members/{user}",
                content=as_json(MemberChange(role=role)),
                headers=ANY_STATE,
                repeatable=True,
            ),
        )

    def remove(self, user: str) -> None:
        """Take a user's role away."""
        self.transport.send("DELETE", f"/projects/{self.project}/members/{user}", headers=ANY_STATE, repeatable=False)

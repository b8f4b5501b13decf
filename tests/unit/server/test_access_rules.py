"""Scopes, roles, passwords and tokens, without a database."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.support.present import present

from marey_schemas.access import Role
from marey_server.access import passwords, roles, scopes
from marey_server.access.principal import ANONYMOUS, SYSTEM, Principal
from marey_server.access.secret_tokens import (
    attempt_secret,
    is_sealed,
    issue_attempt_token,
    issue_user_token,
    sealed,
    split_user_token,
    token_hash,
)
from marey_server.store.ids import is_id, new_id


@pytest.fixture
def cheap_hashes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passwords, "LOG2_N", 4)


def test_roles_are_ordered() -> None:
    order = [Role.READER, Role.CONTRIBUTOR, Role.MAINTAINER, Role.OWNER]
    for i, role in enumerate(order):
        assert [roles.includes(role, need) for need in order] == [j <= i for j in range(4)]


def test_a_bound_scope_reaches_its_project_only() -> None:
    assert scopes.allows(["write!project=walk"], "write", "walk")
    assert not scopes.allows(["write!project=walk"], "write", "run")
    assert not scopes.allows(["write!project=walk"], "write")
    assert not scopes.allows(["write!project=walk"], "read", "walk")
    assert scopes.allows(["write"], "write", "walk")


scope_texts = st.sampled_from(["read", "write", "jobs", "read!project=a", "write!project=a", "write!project=b"])


@given(st.lists(scope_texts), st.lists(scope_texts))
def test_what_does_not_exceed_allows_nothing_more(wanted: list[str], held: list[str]) -> None:
    if not scopes.exceeding(wanted, held):
        for need in ("read", "write", "jobs"):
            for project in ("a", "b", None):
                assert scopes.allows(held, need, project) or not scopes.allows(wanted, need, project)


def test_a_password_matches_its_own_hash_only(cheap_hashes: None) -> None:
    stored = passwords.hash_password("pässwörd 1\ud800")
    assert passwords.password_matches("pässwörd 1\ud800", stored)
    assert not passwords.password_matches("pässwörd 2", stored)
    assert not passwords.password_matches("", None)
    assert passwords.hash_password("same") != passwords.hash_password("same")


def test_a_hash_keeps_working_when_new_ones_cost_more(cheap_hashes: None, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = passwords.hash_password("correct horse")
    monkeypatch.setattr(passwords, "LOG2_N", 5)
    assert passwords.password_matches("correct horse", stored)


def test_hashing_really_costs_32_mib() -> None:
    assert (1 << passwords.LOG2_N) * 128 * 8 == 32 * 2**20
    assert passwords.password_matches("correct horse", passwords.hash_password("correct horse"))


def test_tokens_of_users_and_attempts_are_told_apart() -> None:
    user, attempt = issue_user_token(), issue_attempt_token()
    prefix, secret = present(split_user_token(user.text))
    assert prefix == user.prefix
    assert secret not in (user.secret_hash, prefix)
    assert split_user_token(attempt.text) is None
    assert attempt_secret(attempt.text)
    assert attempt_secret(user.text) is None


def test_a_seal_shows_that_a_server_with_the_same_key_issued_a_token() -> None:
    attempt, key = issue_attempt_token(), b"k" * 32
    text = sealed(attempt, key)
    assert is_sealed(text, key)
    assert attempt_secret(text) == attempt_secret(attempt.text)
    assert token_hash(text) == token_hash(attempt.text) == token_hash(f"{attempt.text}_invented") == attempt.secret_hash
    user = issue_user_token().text
    for other in (attempt.text, f"{text[:-1]}x", f"{text}é", user, "mareyjob_", "mareyjob__", text[9:]):
        assert not is_sealed(other, key)
    assert not is_sealed(text, b"x" * 32)


def test_the_name_of_a_user_is_required_of_users_only() -> None:
    assert Principal("user", "user_1", "ada").require_user_name() == "ada"
    for other in (ANONYMOUS, SYSTEM, Principal("attempt", job_id="job_1")):
        with pytest.raises(TypeError, match=f"{other.kind} is not a user"):
            other.require_user_name()


@pytest.mark.parametrize("kind", ["project", "clip", "search-tree"])
def test_ids_have_a_form_that_names_rarely_have(kind: str) -> None:
    text = new_id(kind)
    assert is_id(text)
    for other in (text[:-1], f"{text}0", text.upper(), text.partition("_")[2], f"raw/{text}", "ada", "walk_01", ""):
        assert not is_id(other)

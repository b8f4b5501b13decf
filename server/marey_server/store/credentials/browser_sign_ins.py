"""Sign-ins with an identity provider, from their start in a program to the token; all servers share them.

1. A program begins a sign-in, and keeps a secret, the verifier.
2. One browser opens the sign-in. It gets a cookie, and the provider gets a random state.
3. The provider sends the browser back. The state works once, and only in the browser with the cookie.
4. The browser gets a code. The program redeems the code, once, with its verifier, and gets a token.

The database contains only hashes of the verifier, the cookie, the state and the code. A state is used up even if the
sign-in fails afterwards; the person must then begin a new sign-in.
"""

from __future__ import annotations

import re
import shlex

from sqlalchemy import delete, func, insert, select, update

from marey_schemas.access import NewToken
from marey_schemas.names import UserName
from marey_schemas.sign_ins import BrowserSignInCode, BrowserSignInCreate
from marey_server.access.id_tokens import Person
from marey_server.access.secret_tokens import hash_secret
from marey_server.errors import ForbiddenProblem, NotFoundProblem, TooManyRequestsProblem, UnavailableProblem
from marey_server.store import rate_limits, users
from marey_server.store.credentials import identities, sign_ins, tokens
from marey_server.store.credentials.sign_ins import MINUTE_US, SignInTry
from marey_server.store.ids import new_id
from marey_server.store.rate_limits import RateLimit, key_of
from marey_server.store.tables import browser_sign_in, identity
from marey_server.store.transaction import Transaction

LIFETIME_US = 600 * 1_000_000
"""Time in which a person must sign in."""
MOST_WAITING = 10_000
"""Greatest number of sign-ins that are not complete."""
_USER_NAME = re.compile(UserName.__metadata__[0].pattern)


def begin(tx: Transaction, request: BrowserSignInCreate, address: str, per_minute: int, longest_s: int) -> str:
    """Begin a sign-in, and return its id. Its token will be valid for `longest_s` seconds at most.

    Raises `TooManyRequestsProblem` if the address begins more than `per_minute` sign-ins a minute, and
    `UnavailableProblem` if `MOST_WAITING` sign-ins of all addresses are not complete.
    """
    if wait_s := rate_limits.count(tx, RateLimit(key_of("browser", address), per_minute, MINUTE_US // per_minute)):
        raise TooManyRequestsProblem(
            f"Too many sign-ins were begun from your address; wait {wait_s} s.",
            code="too-many-sign-ins",
            context={"limit": "address", "wait_s": wait_s},
            headers={"Retry-After": str(wait_s)},
        )
    if tx.execute(select(func.count()).select_from(browser_sign_in)).scalar_one() >= MOST_WAITING:
        raise UnavailableProblem("Too many sign-ins are under way; try again in a few minutes.", code="busy")
    row = {
        "id": new_id("sign_in"), "challenge": request.challenge, "port": request.port,
        "lifetime_s": min(request.expires_in_s, longest_s), "created_us": tx.now_us,
        "expires_us": tx.now_us + LIFETIME_US,
    }  # fmt: skip
    tx.execute(insert(browser_sign_in).values(**row))
    return str(row["id"])


def invalid_sign_in() -> NotFoundProblem:
    """Return the error for a sign-in that cannot continue; its text does not show why."""
    return NotFoundProblem(
        "This sign-in is not valid here: it is unknown, complete or too old, or it was opened in another browser. Run "
        "the command again.",
        code="sign-in-invalid",
    )


def open_in_browser(tx: Transaction, sign_in_id: str, cookie: str, state: str) -> None:
    """Bind a sign-in to the browser that has `cookie`; the provider will send `state` back with this browser.

    Raises `NotFoundProblem` if the sign-in does not exist, has expired, or was opened in a browser already.
    """
    unopened = browser_sign_in.c.browser_hash.is_(None), browser_sign_in.c.expires_us > tx.now_us
    bound = update(browser_sign_in).where(browser_sign_in.c.id == sign_in_id, *unopened)
    if tx.execute(bound.values(browser_hash=hash_secret(cookie), state_hash=hash_secret(state))).rowcount != 1:
        raise invalid_sign_in()


def use_state(tx: Transaction, state: str, cookie: str) -> tuple[str, int | None]:
    """Use up the state that the provider sent back with the browser; return the id and the port of the sign-in.

    The port is the one at which the program on the person's machine waits for the code, or None if it does not wait.
    Raises `NotFoundProblem` if the state is not valid in the browser with this cookie.
    """
    which = (
        browser_sign_in.c.state_hash == hash_secret(state),
        browser_sign_in.c.browser_hash == hash_secret(cookie),
        browser_sign_in.c.expires_us > tx.now_us,
    )
    used = update(browser_sign_in).where(*which).values(state_hash=None)
    row = tx.execute(used.returning(browser_sign_in.c.id, browser_sign_in.c.port)).first()
    if row is None:
        raise invalid_sign_in()
    return row.id, row.port


def confirm(tx: Transaction, sign_in_id: str, code: str, person: Person, *, creates_users: bool) -> str:
    """Record that the identity provider has identified a person; return the name of the person's user.

    The browser then gets `code`, with which the program completes the sign-in. If `creates_users` is true, a new user
    is created for a person who is not linked with a user. Raises `ForbiddenProblem` if the person has no user, or a
    disabled user. Raises `ConflictProblem` if the name of the new user is taken, and `NotFoundProblem` if the sign-in
    cannot continue.
    """
    found = identities.find_identity(tx, person.issuer, person.subject)
    if found is None and not creates_users:
        raise ForbiddenProblem(
            f"No user is linked with you. Send this line to an administrator, who replaces NAME by your user name: "
            f"marey user link NAME {shlex.quote(person.subject)}",
            code="identity-unknown",
            context={"subject": person.subject},
        )
    if found is None:
        tx.principal = users.sign_up(tx, _name_of(person.name), person.display_name, None)
        user = tx.principal
        found = identities.insert_identity(tx, str(user.user_id), user.require_user_name(), person)
    else:
        user = users.active_principal(tx, found.user_id)
    used = update(identity).where(identity.c.id == found.id).values(last_used_us=tx.now_us)
    if tx.execute(used).rowcount != 1:  # the link has ended since it was read
        raise invalid_sign_in()
    which = browser_sign_in.c.id == sign_in_id, browser_sign_in.c.code_hash.is_(None)
    values = {"code_hash": hash_secret(code), "identity_id": found.id}
    if tx.execute(update(browser_sign_in).where(*which).values(**values)).rowcount != 1:
        raise invalid_sign_in()
    return user.require_user_name()


def _name_of(claim: str | None) -> str:
    """Return the name of a new user, from a claim of the identity provider: the part before @, in lower case.

    Raises `ForbiddenProblem` if the result is no valid user name.
    """
    name = (claim or "").partition("@")[0].lower()
    if not _USER_NAME.fullmatch(name):
        raise ForbiddenProblem(
            "The identity provider sent no valid user name for you: a user name has at most 64 letters (a to z), "
            "digits, `.`, `_` and `-`, and begins and ends with a letter or digit. Ask an administrator to create a "
            "user and to link you with this user.",
            code="no-user-name",
        )
    return name


def redeem(tx: Transaction, sign_in_id: str, request: BrowserSignInCode, attempt: SignInTry) -> NewToken:
    """End a sign-in whose code and verifier are given, and return the token.

    `attempt` is the counted try, which no longer counts afterwards. Raises `NotFoundProblem` if the code or the
    verifier is wrong or the sign-in has expired, and `ForbiddenProblem` if the user is disabled.
    """
    which = (
        browser_sign_in.c.id == sign_in_id,
        browser_sign_in.c.code_hash == hash_secret(request.code.get_secret_value()),
        browser_sign_in.c.challenge == hash_secret(request.verifier.get_secret_value()),
        browser_sign_in.c.expires_us > tx.now_us,
    )
    ended = delete(browser_sign_in).where(*which)
    row = tx.execute(ended.returning(browser_sign_in.c.identity_id, browser_sign_in.c.lifetime_s)).first()
    if row is None:
        raise invalid_sign_in()
    owner = select(identity.c.user_id).where(identity.c.id == row.identity_id)
    tx.principal = users.active_principal(tx, tx.execute(owner).scalar_one())
    sign_ins.uncount(tx, attempt)
    return tokens.create_session(tx, row.lifetime_s)


def delete_expired(tx: Transaction) -> int:
    """Delete some of the sign-ins that were not completed in time; return their number."""
    expired = (
        select(browser_sign_in.c.id)
        .where(browser_sign_in.c.expires_us <= tx.now_us)
        .limit(rate_limits.FORGOTTEN_AT_ONCE)
    )
    if tx.is_postgres:
        expired = expired.with_for_update(skip_locked=True)
    return tx.execute(delete(browser_sign_in).where(browser_sign_in.c.id.in_(expired))).rowcount

"""Quotas of amounts per day: the bytes that a user sends, and the inputs of the jobs that a user submits.

Each quota has one row for each user (`rate_limits`). So a count takes the same time, however much was counted before.
The server and attempts of jobs have no quotas.
"""

from __future__ import annotations

from marey_server.errors import QuotaExceededProblem
from marey_server.store import rate_limits
from marey_server.store.rate_limits import DailyAmount, key_of
from marey_server.store.transaction import Transaction

_BYTES = "user_daily_bytes"
_INPUTS = "user_daily_inputs"
_SENTENCES = {
    _BYTES: "You may send {most:,} new bytes per day, and this request needs {amount:,} more.",
    _INPUTS: "You may submit jobs with {most:,} inputs per day, and this needs {amount:,} more.",
}


def require_sendable(tx: Transaction, size_bytes: int) -> None:
    """Raise `QuotaExceededProblem` if the caller may not send `size_bytes` new bytes at present.

    The bytes are not counted; call `count_sent` as well.
    """
    if (limit := _part_of_day(tx, _BYTES, _caller(tx), size_bytes)) is not None:
        _require(tx, _BYTES, size_bytes, rate_limits.wait_s(tx, limit))


def count_sent(tx: Transaction, size_bytes: int) -> None:
    """Count new bytes that the caller sends; they take space for a day, even if no item ever uses them.

    Call this once, at the end of a transaction: until the transaction ends, other counts of the same user wait. Raises
    `QuotaExceededProblem` if the caller has sent too many bytes.
    """
    _count(tx, _BYTES, _caller(tx), size_bytes)


def uncount_sent(tx: Transaction, size_bytes: int) -> None:
    """Undo the count of bytes that the caller has announced but not sent, or that the server had stored already."""
    if (limit := _part_of_day(tx, _BYTES, _caller(tx), size_bytes)) is not None:
        rate_limits.uncount(tx, limit)


def require_submittable(tx: Transaction, inputs: int) -> None:
    """Raise `QuotaExceededProblem` if jobs have more inputs than the caller may submit in a whole day.

    Call `count_submitted` as well. This early check avoids work for jobs that can never be submitted.
    """
    if _caller(tx) is not None:
        _require(tx, _INPUTS, inputs, 0)


def count_submitted(tx: Transaction, inputs: int) -> None:
    """Count the inputs of jobs that the caller submits, with those of the tasks of these jobs.

    The row of a job contains all of its inputs, and is kept after the job has ended or was cancelled. Call this once,
    at the end of a transaction: until the transaction ends, other counts of the same user wait. Raises
    `QuotaExceededProblem` if the caller has submitted too many inputs.
    """
    _count(tx, _INPUTS, _caller(tx), inputs)


def count_late(tx: Transaction, author_id: str, inputs: int) -> None:
    """Count inputs that a job of a user gets after its submission, as `count_submitted` does."""
    _count(tx, _INPUTS, author_id, inputs)


def _caller(tx: Transaction) -> str | None:
    """Return the id of the caller if quotas apply: of a user, but not of the server or an attempt; otherwise None."""
    return tx.principal.user_id if tx.principal.kind == "user" else None


def _count(tx: Transaction, quota: str, user_id: str | None, amount: int) -> None:
    if (limit := _part_of_day(tx, quota, user_id, amount)) is not None:
        too_much = amount > getattr(tx.quotas, quota)
        _require(tx, quota, amount, 0 if too_much else rate_limits.count(tx, limit))


def _require(tx: Transaction, quota: str, amount: int, wait_s: int) -> None:
    """Raise `QuotaExceededProblem` if the user must wait (`wait_s`), or the amount is larger than the whole quota."""
    most = getattr(tx.quotas, quota)
    never = amount > most
    if wait_s == 0 and not never:
        return
    remedy = f"The operator can raise the setting `{quota}`."
    when = "" if never else f"Try again in {wait_s} s. "
    raise QuotaExceededProblem(
        f"{_SENTENCES[quota].format(most=most, amount=amount)} {when}{remedy}",
        context={"quota": quota, "limit": most, "wait_s": None if never else wait_s},
    )


def _part_of_day(tx: Transaction, quota: str, user_id: str | None, amount: int) -> DailyAmount | None:
    """Return the daily limit for an amount of a user, or None if no limit applies."""
    if user_id is None or amount <= 0:
        return None
    key = key_of({_BYTES: "sent-bytes"}.get(quota, quota), user_id)
    return DailyAmount.part(key, amount, max(1, getattr(tx.quotas, quota)))

"""States of proposals and of their checks, and verdicts of reviews; commands load them without pydantic."""

from enum import StrEnum


class ProposalState(StrEnum):
    """State of a proposal; merged and closed ones never change again."""

    OPEN = "open"
    MERGED = "merged"
    CLOSED = "closed"


class Verdict(StrEnum):
    """Verdict of a review."""

    APPROVE = "approve"
    REQUEST_CHANGES = "request-changes"
    COMMENT = "comment"


class CheckState(StrEnum):
    """State of a check."""

    PENDING = "pending"
    SUCCEEDED = "succeeded"
    FAILED = "failed"

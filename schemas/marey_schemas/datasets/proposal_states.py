"""States of proposals and checks, and verdicts of reviews; commands can load this module without pydantic."""

from enum import StrEnum


class ProposalState(StrEnum):
    """State of a proposal; merged and closed proposals never change their state again."""

    OPEN = "open"
    MERGED = "merged"
    CLOSED = "closed"


class Verdict(StrEnum):
    """Verdict of a review of a proposal: `approve`, `request-changes`, or `comment` without a decision."""

    APPROVE = "approve"
    REQUEST_CHANGES = "request-changes"
    COMMENT = "comment"


class CheckState(StrEnum):
    """State of a check of a proposal: `pending`, `succeeded` or `failed`."""

    PENDING = "pending"
    SUCCEEDED = "succeeded"
    FAILED = "failed"

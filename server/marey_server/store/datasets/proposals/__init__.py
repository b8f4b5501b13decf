"""Proposals to merge a version into a branch, with comments, reviews and checks."""

from marey_server.store.datasets.proposals.accepting import (
    PreparedAcceptance,
    merge_proposal,
    prepare_acceptance,
    prepare_waiting,
    read_proposal,
    withdraw_merge,
)
from marey_server.store.datasets.proposals.discussing import add_comment, list_comments
from marey_server.store.datasets.proposals.opening import close_proposal, list_proposals, open_proposal
from marey_server.store.datasets.proposals.reviewing import add_review, list_reviews, report_check
from marey_server.store.datasets.proposals.waiting import WaitingMerges

__all__ = [
    "PreparedAcceptance",
    "WaitingMerges",
    "add_comment",
    "add_review",
    "close_proposal",
    "list_comments",
    "list_proposals",
    "list_reviews",
    "merge_proposal",
    "open_proposal",
    "prepare_acceptance",
    "prepare_waiting",
    "read_proposal",
    "report_check",
    "withdraw_merge",
]

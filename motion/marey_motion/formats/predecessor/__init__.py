"""Readers and writers for documents of Marey's predecessor, the system of Herrmann et al. (2019)."""

from marey_motion.formats.predecessor.clips import write_predecessor, write_predecessor_skeleton
from marey_motion.formats.predecessor.documents import read_predecessor

__all__ = ["read_predecessor", "write_predecessor", "write_predecessor_skeleton"]

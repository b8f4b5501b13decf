"""Groups of examples from the same take or performer, so that no group is in both training and test of a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.alignment.aligning import MIRRORED
from marey_motion.arrays import Ints

LEAST_SUBJECTS = 3
LEAST_FOLDS = 2
LEAST_TRAINED = 4
"""Least number of examples that must remain for training when a group is left out."""


@dataclass(frozen=True, eq=False)
class ExampleGroups:
    """Take and performer of each of m examples, as numbers.

    Parameters
    ----------
    takes : (m,) int64    number of each example's take; examples from one take have the same number, and so have an
        example and its mirrored copy
    subjects : (m,) int64 or None    number of each example's performer; None if the performer of any example is
        unknown, or if there are fewer than three performers
    """

    takes: Ints
    subjects: Ints | None

    @classmethod
    def of(cls, aligned: AlignedSet) -> ExampleGroups:
        """Read the groups of aligned examples.

        Parameters
        ----------
        aligned : AlignedSet    m examples

        Returns
        -------
        ExampleGroups    their takes and performers
        """
        performers = [clip.recording.subject for clip in aligned.clips]
        known = all(performers) and len(set(performers)) >= LEAST_SUBJECTS
        takes = [clip.recording.take or clip.uid.removesuffix(MIRRORED) for clip in aligned.clips]
        return cls(_numbered(takes), _numbered(performers) if known else None)

    @classmethod
    def alone(cls, count: int) -> ExampleGroups:
        """Make groups in which each example is a take of its own.

        Parameters
        ----------
        count : int    number of examples

        Returns
        -------
        ExampleGroups    one take for each example
        """
        return cls(np.arange(count), None)

    @property
    def take_count(self) -> int:
        """Number of takes."""
        return int(self.takes.max(initial=-1)) + 1

    @property
    def subject_count(self) -> int:
        """Number of performers; 0 if they are unknown or fewer than three."""
        return 0 if self.subjects is None else int(self.subjects.max()) + 1

    def take_folds(self, most: int, seed: int) -> Ints | None:
        """Divide the examples into parts, with all examples of a take in the same part.

        Parameters
        ----------
        most : int    greatest number of parts
        seed : int    the same seed gives the same parts

        Returns
        -------
        (m,) int64 or None    number of the part of each example; None if there would be fewer than two parts, or if too
            few examples would remain for training
        """
        count = min(most, self.take_count)
        if count < LEAST_FOLDS:
            return None
        parts = np.random.Generator(np.random.Philox(seed)).permutation(self.take_count) % count
        return _usable(np.asarray(parts[self.takes], dtype=np.int64))

    def subject_folds(self) -> Ints | None:
        """Divide the examples into parts, one for each performer.

        Returns
        -------
        (m,) int64 or None    number of the part of each example; None if there are fewer than three performers, or if
            too few examples would remain for training
        """
        return None if self.subjects is None else _usable(self.subjects)


def _numbered(names: Sequence[str]) -> Ints:
    """Return a number for each name; equal names have equal numbers, which count from 0 in order of appearance."""
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(name, len(numbers)) for name in names], dtype=np.int64)


def _usable(parts: Ints) -> Ints | None:
    """Return the parts (m,), or None if too few examples remain for training when the largest part is left out."""
    return parts if len(parts) - np.bincount(parts).max() >= LEAST_TRAINED else None

"""Left and right swapped."""

from __future__ import annotations

from marey_motion.editing.take import Take
from marey_motion.mirroring import mirror_motion


def mirror(take: Take) -> Take:
    """The motion seen in a mirror, by the skeleton's own pairs of joints, whatever their names and axes."""
    return take.moved(mirror_motion(take.skeleton, take.body.partners, take.motion))

"""Pages that play motion without a server or a network: one file with the viewer and packed motion."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marey_client.downloads import saved_atomically
from marey_client.errors import BadArgument, MareyError, NotFound
from marey_client.handles.clips import ClipHandle
from marey_client.handles.models import ModelHandle
from marey_client.items import ItemHandle
from marey_client.poses.kinematics import read_rig
from marey_client.poses.packing import pack_motion
from marey_client.poses.strips import ClipOfStrip
from marey_client.transport import Transport
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.references import RevisionRef
from marey_schemas.sign_ins import PLAYER_PATH

FORMAT = 1
"""Version of the data in a page; `web/src/motion/packed.ts` reads it."""
MOST_MOTIONS = 12
_PLACE = b'<script type="application/json" id="motion"></script>'


@dataclass(frozen=True)
class ShownMotion:
    """A motion with its skeleton, and the name that a page shows beside it."""

    name: str
    motion: MotionDocument
    hierarchy: dict[str, Any]
    mapping: dict[str, Any] | None = None

    def packed(self) -> dict[str, Any]:
        """Return the motion as a member of the data of a page."""
        skeleton = {"hierarchy": self.hierarchy, "mapping": self.mapping}
        return {"name": self.name, **skeleton, **pack_motion(self.motion)}


def read_template(transport: Transport) -> bytes:
    """Request the server's template of a page, without motion. Raises `MareyError` if the server has no template."""
    try:
        return transport.send("GET", PLAYER_PATH, headers={"Accept": "text/html"}).content
    except NotFound as error:
        raise MareyError(
            f"{transport.url} offers no page that plays motion: it was installed without pages, or is older than this "
            "command. Run `make web` in its source tree or upgrade it, or draw a picture to a .png file"
        ) from error


def page_data(title: str, motions: Sequence[ShownMotion]) -> str:
    """Return the data of a page that plays motions as JSON. Each `<` is escaped, so that no name can end an element."""
    content = {"format": FORMAT, "title": title, "motions": [one.packed() for one in motions]}
    return json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def page_with(template: bytes, title: str, motions: Sequence[ShownMotion]) -> bytes:
    """Return a page that plays motions. Raises `MareyError` if the template has no element for their data."""
    if template.count(_PLACE) != 1:
        raise MareyError(
            "the server's page has no element for motion, because client and server have different versions; upgrade "
            "the older one"
        )
    data = page_data(title, motions)
    return template.replace(_PLACE, _PLACE.replace(b"></", b">" + data.encode() + b"</"))


def save_page(transport: Transport, target: Path, motions: Sequence[ShownMotion], about: str = "") -> None:
    """Write a page that plays motions beside each other to a file; if writing fails, `target` stays as it was.

    The title of the page is `about`, which says what the motions are; without it, the names of the motions.
    """
    if not 1 <= len(motions) <= MOST_MOTIONS:
        raise BadArgument(f"a page plays 1 to {MOST_MOTIONS} motions, not {len(motions)}")
    names = " beside ".join(one.name for one in motions)
    title = names if not about else f"{about}: {names}" if len(motions) == 1 else about
    page = page_with(read_template(transport), title, motions)
    with saved_atomically(target) as file:
        file.write(page)


def motions_of_clips(clips: Sequence[tuple[ClipHandle, int | None]], frames: slice | None) -> list[ShownMotion]:
    """Read clips, each at a revision (None: the handle's revision), as motions of a page.

    `frames` counts in frames of the first clip; of every other clip, the frames at the same times are read. If two
    clips have the same path, the names contain the revisions.
    """
    shown = [ClipOfStrip(clip, revision) for clip, revision in clips]
    paths = [one.clip.path for one in shown]
    return [
        _read_clip(one, _at_times_of(shown[0], one, frames), with_revision=paths.count(one.clip.path) > 1)
        for one in shown
    ]


def _at_times_of(leader: ClipOfStrip, other: ClipOfStrip, frames: slice | None) -> slice | None:
    if frames is None or other is leader:
        return frames
    ratio = other.frame_rate_hz / leader.frame_rate_hz
    return slice(*(None if one is None else round(one * ratio) for one in (frames.start, frames.stop)))


def _read_clip(one: ClipOfStrip, frames: slice | None, *, with_revision: bool) -> ShownMotion:
    name = f"{one.clip.path}, revision {one.number}" if with_revision else one.clip.path
    return shown_motion(one.clip, name, one.clip.motion(frames=frames, revision=one.number))


def motions_of_samples(model: ModelHandle, revision: int | None, n: int, seed: int) -> list[ShownMotion]:
    """Draw `n` samples of a model, and return them as motions for a page."""
    drawn = model.sample(n, seed, revision=revision)
    return [shown_motion(model, f"sample {number}", motion) for number, motion in enumerate(drawn.motions, 1)]


def shown_motion(item: ItemHandle, name: str, motion: MotionDocument) -> ShownMotion:
    """Return a motion with its skeleton; the skeleton is read from the project of `item`."""
    reference = motion.skeleton
    assert isinstance(reference, RevisionRef)
    rig = read_rig(item, reference)
    try:
        mapping = rig.handle.part("mapping", revision=reference.revision)
    except NotFound:  # the page then finds sides and feet by the names of joints
        mapping = None
    return ShownMotion(name, motion, rig.hierarchy.model_dump(mode="json", by_alias=True, exclude_none=True), mapping)

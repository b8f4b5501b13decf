"""Real takes of one folder as clips of a matching database."""

from pathlib import Path

from marey_motion.clip import Clip
from marey_motion.formats import read_motion
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.database import SourceClip
from marey_motion.rigs import map_joints
from marey_schemas.formats.companions import pair_companions


def read_takes(folder: Path, *patterns: str) -> list[SourceClip]:
    """Read the takes whose paths match a pattern, with the companion files that they need."""
    names = sorted({str(path.relative_to(folder)) for pattern in patterns for path in folder.glob(pattern)})
    companions = {pairing.file: pairing.companion for pairing in pair_companions(names)}
    takes = []
    for name in names:
        companion = companions.get(name)
        data = None if companion is None else (folder / companion).read_bytes()
        clip = read_motion((folder / name).read_bytes(), name, companion=data, companion_name=str(companion)).clip
        if clip is not None:
            takes.append(SourceClip(name, Path(name).stem, clip))
    return takes


def body_of(clip: Clip) -> MatchingBody:
    """Return the joints that motion matching uses."""
    return MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))

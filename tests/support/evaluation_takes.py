"""A few walks as files, for tests of evaluations."""

from math import radians
from pathlib import Path

from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait

SPEEDS_M_S = (1.0, 1.5, 2.0)
TURN_RATES_DEG_S = (-60.0, 0.0, 60.0)


def write_walks(folder: Path, seconds: float = 6.0) -> Path:
    """Write nine walks of one skeleton as BVH files, straight ahead and turning both ways; return their folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for speed in SPEEDS_M_S:
        for turn_rate in TURN_RATES_DEG_S:
            clip = generate_gait(speed, radians(turn_rate), seconds)
            (folder / f"walk {speed:g} {turn_rate:g}.bvh").write_bytes(write_bvh(clip))
    return folder

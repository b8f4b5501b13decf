"""A few walks as files, and quick evaluations, for tests of evaluations."""

import functools
from math import radians
from pathlib import Path

from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait

SPEEDS_M_S = (1.0, 1.5, 2.0)
TURN_RATES_DEG_S = (-60.0, 0.0, 60.0)
QUICK = ("--replicates", "1", "--no-report")
"""Options of `marey evaluate` for pages that show something else than the quality of motion."""


def quick(arguments: list[str]) -> list[str]:
    """Return the arguments of a command of a page, with the options `QUICK` if it is `marey evaluate`."""
    return [*arguments, *QUICK] if arguments[0] == "evaluate" else arguments


def write_walks(folder: Path, seconds: float = 6.0) -> Path:
    """Write nine walks of one skeleton as BVH files, straight ahead and turning both ways; return their folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in _walks(seconds).items():
        (folder / name).write_bytes(content)
    return folder


@functools.cache
def _walks(seconds: float) -> dict[str, bytes]:
    """Return the walks by the names of their files. They are generated once, because many tests use them."""
    return {
        f"walk {speed:g} {turn_rate:g}.bvh": write_bvh(generate_gait(speed, radians(turn_rate), seconds))
        for speed in SPEEDS_M_S
        for turn_rate in TURN_RATES_DEG_S
    }

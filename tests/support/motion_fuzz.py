"""Fuzzing of readers: randomly broken motion files must give a motion or an error of the reader, in bounded time.

As a program, `python -m tests.support.motion_fuzz SECONDS [SEED]` runs for this many seconds of processor time. If a
reader does anything else, the file is kept in the current folder.
"""

from __future__ import annotations

import functools
import random
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from types import FrameType

from tests.support.motion_files import AMC, ASF, POSITIONS, ZXY, bvh, nested

from marey_motion.errors import MotionError
from marey_motion.formats import ImportOptions, read_motion, write_motion, write_npz, write_predecessor_skeleton
from marey_motion.gait import generate_gait

LONGEST_S = 10
"""Longest processor time in seconds that a reader may need for a broken file."""
Seed = tuple[str, bytes, bytes | None]
# Pieces that mean something to one of the readers, to be put where they do not belong.
_PIECES = [
    *b"HIERARCHY|ROOT |JOINT |End Site|OFFSET |CHANNELS 6 |MOTION|Frames: |Frame Time: |{|}|\n|\r|\t|\x00|\xff".split(
        b"|"
    ),
    *b"nan|inf|-1.#IND|1e999|-1e-999|1,5|99999999999999999999|0.1234567890123456789|-0|+|.|e|0x1|1_0".split(b"|"),
    *b":bonedata|:hierarchy|begin|end|dof rx ry rz|axis 0 0 0 XYZ|root|#|:DEGREES|:RADIANS|name |length ".split(b"|"),
    *b'null|true|[]|{}|"|[[|1e400|"poses"|"frames"|"jointDescs"|"children"|"root"|PK\x03\x04|BZh9|\x93NUMPY'.split(
        b"|"
    ),
]


class TooSlow(BaseException):
    """A reader took longer than `LONGEST_S`; readers cannot catch this error by `except Exception`."""


@functools.cache
def seeds() -> tuple[Seed, ...]:
    """Return one valid file for each format and variant: (name, file, companion file or None)."""
    clip = generate_gait(1.2, 0.0, 0.2, 30.0)
    skeleton = write_predecessor_skeleton(clip.skeleton)
    six = f"{POSITIONS} {ZXY}"
    return (
        ("walk.bvh", write_motion(clip, "bvh"), None),
        ("arm.bvh", bvh(["1 2 3 4 5 6 7 8 9"] * 3), None),
        ("six.bvh", bvh(["1 2 3 4 5 6 " * 3] * 2, hierarchy=nested(["a", "b", "c"], [six] * 3)), None),
        ("take.amc", AMC.encode(), ASF.encode()),
        ("body.asf", ASF.encode(), None),
        ("walk.npz", write_npz(clip), None),
        ("skeleton.json", skeleton, None),
        ("skeleton.json", write_predecessor_skeleton(clip.skeleton, form="file"), None),
        ("rows.json", write_motion(clip, "predecessor", encoding="json"), skeleton),
        ("rows.bson", write_motion(clip, "predecessor", encoding="bson"), skeleton),
        ("frames.bz2", write_motion(clip, "predecessor", form="frames"), skeleton),
    )


def broken(data: bytes, source: random.Random) -> bytes:
    """Return the file with one to eight random changes: pieces are removed, repeated, copied, replaced or inserted."""
    text = bytearray(data)
    for _ in range(source.randint(1, 8)):
        start = source.randint(0, len(text))
        stop = min(len(text), start + source.randint(0, 60))
        piece = bytes(text[start:stop])
        match source.randrange(7):
            case 0:
                del text[start:stop]
            case 1:
                text[start:start] = piece * source.randint(1, 50)
            case 2:
                text[start:stop] = source.randbytes(stop - start)
            case 3:
                text[start:start] = source.choice(_PIECES)
            case 4:
                text[start:stop] = source.choice(_PIECES)
            case 5:
                del text[start:]
            case _:
                other = source.randint(0, len(text))
                text[other:other] = piece
    return bytes(text)


def read_broken(seed: Seed, source: random.Random) -> str:
    """Read a broken file; return "read" or the code of the error. Other exceptions are defects of the reader."""
    name, data, companion = seed
    if companion is not None and source.random() < 0.3:
        companion = broken(companion, source)
    else:
        data = broken(data, source)
    options = ImportOptions(
        unit_scale_m=source.choice([None, 0.01]), trust_options=True, trim_rest_pose=True, align_floor=True
    )
    try:
        read_motion(data, name, companion=companion, options=options)
    except MotionError as error:
        return error.code
    except BaseException:
        _keep(name, data, companion)
        raise
    return "read"


def _keep(name: str, data: bytes, companion: bytes | None) -> None:
    Path(f"failed-{name}").write_bytes(data)
    if companion is not None:
        Path(f"failed-{name}.companion").write_bytes(companion)


def _stop(number: int, frame: FrameType | None) -> None:
    raise TooSlow(f"a reader took longer than {LONGEST_S} s of processor time")


def main(seconds: float, seed: int) -> None:
    """Break files for the given processor time, and print the number of each outcome.

    Processor time is measured, because on a busy machine, the elapsed time says nothing about the reader.
    """
    source, files, outcomes = random.Random(seed), seeds(), Counter[str]()
    signal.signal(signal.SIGPROF, _stop)
    end = time.process_time() + seconds
    while time.process_time() < end:
        signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
        outcomes[read_broken(source.choice(files), source)] += 1
        signal.setitimer(signal.ITIMER_PROF, 0)
    print(f"{outcomes.total()} files in {seconds:g} s of processor time, seed {seed}: no crash, no hang")
    for outcome, count in outcomes.most_common():
        print(f"{count:10} {outcome}")


if __name__ == "__main__":
    main(float(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)

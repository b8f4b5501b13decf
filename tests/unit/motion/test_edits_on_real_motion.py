"""Edits of captured motion that an animator would keep: no joint jumps, and no standing foot sinks into its floor.

The short form edits the first seconds of one take of each of three capture systems. The long form, in the tier `soak`,
edits forty takes of seven.
"""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import minimum_filter1d

from marey_motion.clip import Clip
from marey_motion.editing.ground import heights_of_soles
from marey_motion.editing.limb_smoothing import allowed_steps, largest_steps
from marey_motion.editing.registry import EditedClip, edit_clip
from marey_motion.formats import read_motion
from marey_motion.motion import Motion
from marey_motion.rigs import map_joints
from marey_schemas.editing.edits import EditDocument

TAKES = {
    "bandai-namco-1": 10, "bandai-namco-2": 8, "cmu-amc": 12, "cmu-bvh": 3, "cmu-iclone-bvh": 2, "rigs/snu-mss": 3,
    "rigs/snu-mass": 2,
}  # fmt: skip
"""Number of takes by folder: forty takes of seven rigs in total."""
SHORT = {"bandai-namco-1": 1, "cmu-amc": 1, "rigs/snu-mass": 1}
NEEDED = [f"{side}_{part}" for side in ("left", "right") for part in ("shoulder", "elbow", "wrist", "hip", "ankle")]
MOST_STEP = 1.5
"""Largest allowed step of a joint between two frames, as a multiple of the largest step in the unedited take.

The steps that the constraints themselves require are allowed in addition.
"""
MOST_SUNK_M = 0.01


def _read(path: Path, seconds: float = 20.0) -> Clip:
    companion = next(path.parent.glob("*.asf")).read_bytes() if path.suffix == ".amc" else None
    clip = read_motion(path.read_bytes(), path.name, companion=companion).clip
    assert clip is not None
    stop = min(clip.frame_count, round(seconds * clip.frame_rate_hz))
    return clip.sliced(0, stop)


def _takes(mocap: Path, counts: dict[str, int], seconds: float = 20.0) -> dict[str, Clip]:
    """Read takes of people, spread over each folder, of at least one and a half seconds."""
    with (mocap / "MANIFEST.csv").open(newline="") as file:
        paths = [row["path"] for row in csv.DictReader(file) if row["path"].endswith((".bvh", ".amc"))]
    found: dict[str, Clip] = {}
    for folder, count in counts.items():
        here = [path for path in paths if path.startswith(f"{folder}/")]
        spread = [here[i] for i in np.linspace(0, len(here) - 1, min(len(here), 3 * count)).round().astype(int)]
        read = 0
        for path in [*spread[::3], *spread[1::3], *spread[2::3]]:
            clip = _read(mocap / path, seconds)
            known = map_joints(clip.skeleton).joints
            if read < count and all(name in known for name in NEEDED) and clip.frame_count > 1.5 * clip.frame_rate_hz:
                found[path] = clip
                read += 1
            if read == count:
                break
        assert read == count, folder
    return found


def _edited(clip: Clip, command: dict[str, Any], **sources: Clip) -> EditedClip:
    (made,) = edit_clip(clip, EditDocument.model_validate({"commands": [command]}).commands, sources=sources)
    return made


def _places(clip: Clip) -> np.ndarray:
    return Motion.of(clip).positions(clip.skeleton)


def _steps(places: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(np.diff(places, axis=0), axis=-1))


def _soles(clip: Clip) -> np.ndarray:
    known = map_joints(clip.skeleton).joints
    ankles = [clip.skeleton.index_of(known[f"{side}_ankle"]) for side in ("left", "right")]
    return heights_of_soles(clip.skeleton, Motion.of(clip), ankles)


def _constraints(clip: Clip, which: str, places: np.ndarray) -> list[dict[str, Any]]:
    """Return constraints of the right wrist, or of the head for `look`, around the middle of a clip."""
    middle, half = clip.frame_count // 2, int(clip.frame_rate_hz / 3)
    name = "head" if which == "look" else "right_wrist"
    joint, shoulder = (
        clip.skeleton.index_of(map_joints(clip.skeleton).joints[one]) for one in (name, "right_shoulder")
    )
    held: dict[str, Any] = {"kind": "position", "joint": name, "frames": [middle - half, middle + half]}
    near, far = ((places[middle, joint] + offset).tolist() for offset in ((0.05, 0.15, 0.05), (1.5, 0.3, 1.5)))
    return {
        "hold": [held],
        "point": [{**held, "point_m": near}],
        "look": [{**held, "kind": "look_at", "point_m": far}],
        "shoulder": [{**held, "point_m": places[middle, shoulder].tolist()}],
        "in a row": [
            {**held, "frames": [middle - half, middle], "shift_m": [0.0, 0.0, 0.0]},
            {**held, "frames": [middle, middle + half], "point_m": near},
        ],
    }[which]


def _constrained_excess(clip: Clip, which: str) -> float:
    """Return the largest step of a joint, divided by the step that the take and the constraint allow."""
    places, constraints = _places(clip), _constraints(clip, which, _places(clip))
    known = map_joints(clip.skeleton).joints
    joint = clip.skeleton.index_of(known.get(constraints[0]["joint"], constraints[0]["joint"]))
    edited = _places(_edited(clip, {"command": "constrain", "constraints": constraints}).clip)
    need = _steps(edited - places)[:, joint].max()
    if which in ("shoulder", "in a row"):
        elbow = clip.skeleton.index_of(known["right_elbow"])
        moved = np.linalg.norm(edited - places, axis=-1).max(axis=0)
        allowed = allowed_steps(largest_steps(places), moved, 0.3 * clip.frame_rate_hz)
        return float(_steps(edited)[:, elbow].max() / (allowed[elbow] + need))
    # A joint that starts to move from rest, such as an elbow of a bowing person, may move as fast as the need.
    return float(_steps(edited).max() / (MOST_STEP * _steps(places).max() + 2.0 * need))


def _joined_sunk(clip: Clip, blend: str) -> float:
    """Return how far feet sink (metres) around the seam if a cut take is followed by the whole take, out of step."""
    seam, before, after = clip.frame_count * 2 // 5, round(0.4 * clip.frame_rate_hz), round(0.6 * clip.frame_rate_hz)
    joined = _edited(clip.sliced(0, seam), {"command": "concatenate", "source": "other", "blend": blend}, other=clip)
    soles = _soles(clip)
    floors = np.minimum(soles[max(seam - before, 0) : seam].min(axis=0), soles[:after].min(axis=0))
    return float((floors - _soles(joined.clip)[max(seam - before, 0) : seam + after]).max())


def _sunk(clip: Clip, command: dict[str, Any]) -> tuple[float, float]:
    """Return how far feet sink below their nearby minimum (m), and the ratio of the largest steps, after to before."""
    made = _edited(clip, command).clip
    floors = minimum_filter1d(_soles(clip), 2 * int(0.15 * clip.frame_rate_hz) + 1, axis=0)
    return float((floors - _soles(made)).max()), float(_steps(_places(made)).max() / _steps(_places(clip)).max())


FILTERS: tuple[dict[str, Any], ...] = (
    {"command": "smooth"},
    {"command": "smooth", "method": "gaussian", "window_s": 0.4},
    {"command": "plant_feet"},
)


def _faults(clip: Clip) -> list[str]:
    """Apply every kind of edit to a take, and return texts about results that an animator would reject."""
    excesses = {one: _constrained_excess(clip, one) for one in ("point", "hold", "look", "shoulder", "in a row")}
    faults = [f"{one} {excess:.3f} times too fast" for one, excess in excesses.items() if excess > 1.0]
    for blend in ("inertialise", "slerp"):
        sunk = _joined_sunk(clip, blend)
        faults += [f"{blend} sinks {sunk:.3f} m"] if sunk > MOST_SUNK_M else []
    for command in FILTERS:
        sunk, ratio = _sunk(clip, command)
        faults += (
            [f"{command} sinks {sunk:.3f} m, steps {ratio:.2f}"] if sunk > MOST_SUNK_M or ratio > MOST_STEP else []
        )
    return faults


def _judge(takes: dict[str, Clip]) -> None:
    wrong = {name: faults for name, clip in takes.items() if (faults := _faults(clip))}
    assert not wrong


def test_edits_of_three_takes_are_kept(mocap: Path) -> None:
    _judge(_takes(mocap, SHORT, 6.0))


@pytest.mark.soak
def test_edits_of_forty_takes_are_kept(mocap: Path) -> None:
    takes = _takes(mocap, TAKES)
    assert len(takes) == 40
    _judge(takes)


def test_a_pose_for_calibration_in_the_first_frame_is_left_out_of_a_seam(mocap: Path) -> None:
    clip = _read(mocap / "cmu-bvh/01_01.bvh")  # its first frame is a T-pose, a jump away from the second
    joined = _edited(clip.sliced(200, 400), {"command": "concatenate", "source": "other"}, other=clip.sliced(0, 300))
    (finding,) = joined.findings
    assert finding.values == {"rest_pose_frames_after_seam": 1}
    own = _steps(_places(clip)[1:]).max() * clip.frame_rate_hz
    assert _steps(_places(joined.clip)).max() * clip.frame_rate_hz < max(1.5 * own, 10.0)
    assert not _edited(
        clip.sliced(200, 400), {"command": "concatenate", "source": "other"}, other=clip.sliced(1, 300)
    ).findings

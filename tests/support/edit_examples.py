"""One or two examples of every command of an edit, as documents, on the generated walks of `edited_takes`."""

from collections.abc import Callable
from typing import Any

SOURCE = "other"
"""Id of the other clip in the examples."""

EXAMPLES: dict[str, list[dict[str, Any]]] = {
    "trim": [{"start": 10, "stop": 170}, {"start": 3}],
    "split": [{"at": [60, 90]}],
    "concatenate": [{"source": SOURCE}, {"source": SOURCE, "place": "keep", "blend": "slerp", "blend_s": 0.5}],
    "resample": [{"frame_rate_hz": 45.0}],
    "retime": [{"speed": 0.7}],
    "close_loop": [{}, {"in_place": True, "blend_s": 0.4}],
    "translate": [{"shift_m": [1.0, 0.5, -2.0]}],
    "rotate": [{"angle_deg": 30.0}, {"angle_deg": -20.0, "axis": [1.0, 0.0, 0.5], "pivot": "body"}],
    "face": [{"heading_deg": 45.0, "frame": 10}],
    "move_to_origin": [{"frame": 20}],
    "scale": [{"factor": 1.2, "translations": True}],
    "flip_axes": [{"up": "-x", "forward": "+y"}],
    "fix_drift": [{"shift_m": [0.2, 0.0, -0.1], "turn_deg": 10.0, "frames": [20, 80], "profile": "smooth"}],
    "move_to_ground": [{}, {"height_m": 0.1}],
    "find_ground": [{}],
    "find_contacts": [{"speed_m_s": 0.4}],
    "mirror": [{}],
    "smooth": [{}, {"method": "gaussian", "joints": ["Head", "LeftArm"], "frames": [10, 90], "window_s": 0.3}],
    "rotate_joint": [{"joint": "LeftArm", "angle_deg": 20.0, "axis": [0.0, 1.0, 0.0], "space": "world"}],
    "paste": [{"source": SOURCE, "joints": ["LeftArm", "LeftForeArm"], "frames": [20, 80], "source_frames": [0, 40]}],
    "constrain": [
        {
            "constraints": [
                {"kind": "position", "joint": "LeftHand", "frames": [40, 50], "shift_m": [0.0, 0.05, 0.02]},
            ]
        }
    ],
    "plant_feet": [{}],
}


FRAMES: dict[str, Callable[[int, dict[str, Any]], int]] = {
    "trim": lambda frames, given: (given.get("stop") or frames) - given.get("start", 0),
    "concatenate": lambda frames, given: frames + 180 - (30 if given.get("blend") == "slerp" else 0),
    "resample": lambda frames, given: int((frames - 1) * 45 / 60) + 1,
    "retime": lambda frames, given: int((frames - 1) / 0.7) + 1,
}
"""Number of frames of all clips that a command makes of a walk of some frames; commands not listed keep the number."""


def commands_of_all() -> list[dict[str, Any]]:
    """Return every example as a command."""
    return [{"command": name, **given} for name, many in EXAMPLES.items() for given in many]

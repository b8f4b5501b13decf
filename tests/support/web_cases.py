"""Files with which the tests of the browser pages compare their decoder and their kinematics.

`python -m tests.support.web_cases web/tests/cases` writes them for `npm test`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from marey_client.poses.player_pages import ShownMotion
from marey_motion import foot_contacts, forward_directions, generate_gait, global_positions
from marey_motion.clip import Clip
from marey_motion.documents import clip_to_tree, skeleton_to_document
from marey_motion.rigs.mapping import map_joints
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.encoding import blocks
from marey_schemas.encoding.codecs import MSGPACK, encode_tree

SIDES = ("left", "right")
FEET = ("left_toe", "right_toe")


def write_cases(folder: Path) -> None:
    """Write arrays and clips in stored forms, and the values that readers must return for them."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays = _arrays()
    for name, (array, encoded) in arrays.items():
        (folder / f"{name}.blocks").write_bytes(encoded)
        (folder / f"{name}.f4").write_bytes(array.astype("<f4").tobytes())
    clips = _clips()
    for name, clip in clips.items():
        _write_clip(folder / name, clip)
    index = {"arrays": {name: list(array.shape) for name, (array, _) in arrays.items()}, "clips": list(clips)}
    (folder / "index.json").write_text(json.dumps(index))


def _arrays() -> dict[str, tuple[NDArray[np.float32], bytes]]:
    random = np.random.default_rng(70)
    walk = generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.4, duration_s=9.0).poses
    odd = random.normal(size=(300, 5)).astype(np.float32)
    odd[:4, 0] = (0.0, -0.0, 1e-42, -3.4e38)
    turned = random.normal(size=(40, 6, 4))
    turned = (turned / np.linalg.norm(turned, axis=-1, keepdims=True)).astype(np.float32)
    turned[3:7, 2] = ((-1, 0, 0, 0), (0, 0, -0.0, 1), (0, -1, 0, 0), (1, 0, 0, 0))
    return {
        "walk": (walk, blocks.encode(walk)),
        "walk-cut": (walk[13:300], blocks.cut_frames(blocks.encode(walk), 13, 300)),
        "odd": (odd, blocks.encode(odd)),
        "rotations": (turned, blocks.encode(turned)),
        "one-frame": (walk[:1], blocks.encode(walk[:1])),
        "wide": (wide := np.cumsum(random.normal(size=(9, 2500)), axis=0).astype(np.float32), blocks.encode(wide)),
    }


def _clips() -> dict[str, Clip]:
    gait = generate_gait(speed_m_s=1.4, turn_rate_rad_s=-0.6, duration_s=3.0)
    moved = [gait.skeleton.index_of(name) for name in ("Spine", "LeftToeBase")]
    wobble = np.sin(np.arange(len(gait.poses) * 6)).reshape(-1, 2, 3) * 0.03 + gait.skeleton.offsets[moved]
    stretched = Clip(
        gait.skeleton, gait.frame_rate_hz, gait.poses, translations=wobble.astype(np.float32),
        translated_joints=tuple(moved),
    )  # fmt: skip
    return {"gait": gait, "stretched": stretched}


def _write_clip(stem: Path, clip: Clip) -> None:
    tree = clip_to_tree(clip, {"item": "skeleton_x", "revision": 3})
    stem.with_suffix(".msgpack").write_bytes(encode_tree(tree, MSGPACK, arrays="blocks"))
    hierarchy = skeleton_to_document(clip.skeleton)
    stem.with_suffix(".hierarchy.json").write_text(hierarchy.model_dump_json(by_alias=True))
    mapping = map_joints(clip.skeleton)
    stem.with_suffix(".mapping.json").write_text(json.dumps({"joints": dict(mapping.joints)}))
    shown = ShownMotion(
        stem.name, MotionDocument.model_validate(tree), hierarchy.model_dump(), {"joints": mapping.joints}
    )
    (stem.with_suffix(".packed.json")).write_text(json.dumps(shown.packed(), default=dict))
    positions = global_positions(clip, end_sites=True)
    stem.with_suffix(".positions").write_bytes(positions.astype("<f4").tobytes())
    toes = positions[:, [clip.skeleton.index_of(mapping.joints[foot]) for foot in FEET]]
    hips = [[clip.skeleton.index_of(mapping.joints[f"{side}_hip"])] for side in SIDES]
    stem.with_suffix(".facing").write_bytes(forward_directions(positions, *hips).astype("<f4").tobytes())
    stem.with_suffix(".contacts").write_bytes(foot_contacts(toes, clip.frame_rate_hz).astype("|u1").T.tobytes())


if __name__ == "__main__":
    write_cases(Path(sys.argv[1]))

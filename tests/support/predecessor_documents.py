"""Documents of Marey's predecessor, written and read here without the readers and writers of Marey.

Everything in this module is right-handed, in centimetres, with quaternions w, x, y, z. Documents of the predecessor's
database are mirrored in x: a translation (x, y, z) is stored as (-x, y, z), a quaternion (w, x, y, z) as (-w, -x, y,
z).
"""

from __future__ import annotations

import bz2
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import bson
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from tests.support import predecessor_models as models

Array = NDArray[np.float64]
Document = dict[str, Any]


@dataclass(frozen=True)
class Node:
    """Joint or, if it has no children, tip of a chain."""

    name: str
    parent: str | None
    offset: tuple[float, ...]
    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)


_LEG = ((9.0, -4.0, 1.0), (0.5, -43.0, 0.0), (0.0, -41.0, -2.0), (0.0, -7.0, 13.0))
_ARM = ((3.0, 8.0, 0.0), (14.0, 0.0, 0.0), (28.0, 0.0, 0.0), (24.0, 0.0, 0.0), (9.0, 0.0, 0.0))
_TURNED = (0.9689124217106447, 0.0, 0.0, 0.24740395925452294)


def _side(side: str, sign: float) -> list[Node]:
    names = [f"{side}{part}" for part in ("UpLeg", "Leg", "Foot", "Foot_EndSite")]
    legs = [
        Node(name, above, (sign * x, y, z))
        for name, above, (x, y, z) in zip(names, ["Hips", *names], _LEG, strict=False)
    ]
    names = [f"{side}{part}" for part in ("Shoulder", "Arm", "ForeArm", "Hand", "Hand_EndSite")]
    rests = ((1.0, 0.0, 0.0, 0.0), (_TURNED[0], 0.0, 0.0, sign * _TURNED[3]), *[(1.0, 0.0, 0.0, 0.0)] * 3)
    arms = [
        Node(name, above, (sign * x, y, z), rest)
        for name, above, (x, y, z), rest in zip(names, ["Spine1", *names], _ARM, rests, strict=False)
    ]
    return legs + arms


RIG = (
    Node("Hips", None, (1.5, 2.0, -3.0)),
    Node("Spine", "Hips", (0.0, 12.0, -1.0)),
    Node("Spine1", "Spine", (0.0, 20.0, 1.0), (0.9987502603949663, 0.04997916927067833, 0.0, 0.0)),
    Node("Neck", "Spine1", (0.0, 22.0, 0.0)),
    Node("Head", "Neck", (0.0, 10.0, 2.0)),
    Node("Head_EndSite", "Head", (0.0, 18.0, 0.0)),
    *_side("Left", 1.0),
    *_side("Right", -1.0),
)
"""Nodes of a body of 170 cm; the order is not depth first across limbs."""


def joints_of(rig: Sequence[Node]) -> tuple[str, ...]:
    """Return the joints, which are the nodes with children, depth first."""
    parents = {node.parent for node in rig}
    return tuple(node.name for node in _depth_first(rig) if node.name in parents)


def _depth_first(rig: Sequence[Node]) -> list[Node]:
    def below(name: str | None) -> list[Node]:
        return [one for node in rig if node.parent == name for one in (node, *below(node.name))]

    return below(None)


def mirrored(vector: Sequence[float]) -> list[float]:
    """Convert a translation or a quaternion between right-handed and left-handed axes."""
    x, *rest = vector
    return [-x, *rest] if len(vector) == 3 else [-x, -rest[0], *rest[1:]]


def _xyzw(quaternion: Sequence[float]) -> Document:
    return dict(zip("wxyz", quaternion, strict=True))


# Skeletons


def database_skeleton(rig: Sequence[Node] = RIG) -> Document:
    joints, nodes = joints_of(rig), {node.name: node for node in rig}
    return {
        "root": "Hips",
        "jointDescs": [
            {
                "name": node.name, "offset": mirrored(node.offset), "rotation": mirrored(node.rotation),
                "targetName": node.name, "children": [one.name for one in rig if one.parent == node.name],
            }
            for node in rig
        ],
        "jointSequence": list(joints),
        "referencePose": {
            "rotations": [_xyzw(mirrored(nodes[name].rotation)) for name in joints],
            "translations": [dict(zip("xyz", mirrored(nodes[name].offset), strict=True)) for name in joints],
        },
        "head_joint": "Head", "neck_joint": "Neck", "frameTime": 1.0 / 72.0, "name": "custom",
    }  # fmt: skip


def file_skeleton(rig: Sequence[Node] = RIG, model: Document | None = None) -> Document:
    joints = joints_of(rig)
    order = [node.name for node in _depth_first(rig)]

    def nested(node: Node, level: int) -> Document:
        children = [nested(one, level + 1) for one in rig if one.parent == node.name]
        turns = ["Xrotation", "Yrotation", "Zrotation"]
        return {
            "name": node.name, "parent": node.parent, "index": order.index(node.name),
            "quaternion_frame_index": joints.index(node.name) if node.name in joints else -1,
            "offset": list(node.offset), "rotation": list(node.rotation), "fixed": node.name not in joints,
            "channels": (["Xposition", "Yposition", "Zposition"] if level == 0 else []) + turns if children else [],
            "level": level, "node_type": (0 if level == 0 else 1) if children else 2, "children": children,
        }  # fmt: skip

    return {
        "animated_joints": list(joints), "free_joints_map": {}, "skeleton_model": model, "frame_time": 1.0 / 72.0,
        "root": nested(rig[0], 0), "reference_frame": [0.0] * 3 + [1.0, 0.0, 0.0, 0.0] * len(joints),
        "tool_nodes": [], "aligning_root_node": "Hips",
    }  # fmt: skip


_PARTS = {"clavicle": "Shoulder", "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand", "hip": "UpLeg",
          "knee": "Leg", "ankle": "Foot"}  # fmt: skip


def skeleton_model() -> Document:
    """Return a skeleton model whose map and axes differ from those that names and rest pose suggest."""
    sides = {f"{side}_{part}": f"{side.title()}{name}" for side in ("left", "right") for part, name in _PARTS.items()}
    return {
        "joints": {
            "root": "Hips", "pelvis": "Hips", "spine": "Spine", "spine_1": None, "spine_2": "Spine1",
            "neck": "Neck", "head": "Head", "left_toe": None, "right_toe": None, **sides,
        },
        "cos_map": {
            "Hips": {"x": [1.0, 0.0, 0.0], "y": [0.0, 1.0, 0.0]},
            "LeftArm": {"x": [0.0, 0.0, 2.0], "y": [1.0, 0.0, 0.0]},
            "RightArm": {"x": None, "y": [-1.0, 0.0, 0.0]},
        },
        "ik_chains": {"LeftHand": {"root": "LeftArm", "joint": "LeftForeArm", "joint_axis": [0, 1, 0],
                                   "end_effector_dir": [0, 0, 1]}},
        "joint_constraints": {"left_elbow": {"type": "hinge", "axis": [0, 1, 0], "stiffness": 0.5}},
        "foot_joints": ["LeftFoot", "RightFoot"], "foot_correction": {"x": -22, "y": 3}, "heel_offset": [0, -6, -4],
        "free_joints_map": {}, "flip_x_axis": True, "relative_head_dir": [0, 0, 1], "aligning_root_node": "Hips",
    }  # fmt: skip


def rig_of(document: Mapping[str, Any]) -> tuple[Node, ...]:
    """Read a skeleton in the form of the database or of the files."""
    if "jointDescs" in document:
        above = {child: node["name"] for node in document["jointDescs"] for child in node["children"]}
        return tuple(
            Node(one["name"], above.get(one["name"]), tuple(mirrored(one["offset"])), tuple(mirrored(one["rotation"])))
            for one in document["jointDescs"]
        )

    def flat(node: Mapping[str, Any]) -> list[Node]:
        own = Node(node["name"], node["parent"], tuple(node["offset"]), tuple(node["rotation"]))
        return [own, *(one for child in node["children"] for one in flat(child))]

    return tuple(flat(document["root"]))


# Clips


def poses_of(frames: int, seed: int = 0, rig: Sequence[Node] = RIG) -> Array:
    """Return the poses of a walk (frames, 3 + 4 J) with swinging limbs, relative to the root's offset."""
    generator = np.random.default_rng(seed)
    joints = joints_of(rig)
    times = np.arange(frames) / 30.0
    poses = np.zeros((frames, 3 + 4 * len(joints)))
    poses[:, :3] = np.column_stack((2.0 * np.sin(5.0 * times), 92.0 + np.sin(9.0 * times), 120.0 * times))
    for place in range(len(joints)):
        axis = generator.normal(size=3)
        angle = 0.3 * np.sin(5.0 * times + generator.uniform(0.0, 6.0))
        half = np.outer(np.sin(angle / 2.0), axis / np.linalg.norm(axis))
        poses[:, 3 + 4 * place : 7 + 4 * place] = np.column_stack((np.cos(angle / 2.0), half))
    return poses


def clip(poses: Array, *, frame_time: float = 1.0 / 30.0, tips: int = 0, rig: Sequence[Node] = RIG) -> Document:
    """Return a clip as the database stores it, with columns of zeros for `tips` tips, as some writers add them."""
    rows = [[number for part in _parts(pose) for number in mirrored(part)] + [0.0] * 4 * tips for pose in poses]
    return {"poses": rows, "frame_time": frame_time, "joint_sequence": list(joints_of(rig))}


def engine_clip(poses: Array, *, frame_time: float = 1.0 / 30.0, rig: Sequence[Node] = RIG) -> Document:
    """Return a clip in the form of the engine, with an event."""
    frames = []
    for pose in poses:
        root, *rotations = (mirrored(part) for part in _parts(pose))
        frames.append(
            {"rootTranslation": dict(zip("xyz", root, strict=True)), "rotations": [_xyzw(one) for one in rotations]}
        )
    events = [{"eventName": "attach", "eventTarget": "box", "keyframe": 3}]
    return {"frames": frames, "frameTime": frame_time, "jointSequence": list(joints_of(rig)), "events": events}


def _parts(pose: Array) -> list[list[float]]:
    return [pose[:3].tolist(), *(pose[start : start + 4].tolist() for start in range(3, len(pose), 4))]


def read_clip(document: Mapping[str, Any]) -> tuple[tuple[str, ...], Array]:
    """Read a clip of either form; return its joints and its poses."""
    if "frames" in document:
        rows = [
            [one["rootTranslation"][axis] for axis in "xyz"]
            + [turn[part] for turn in one["rotations"] for part in "wxyz"]
            for one in document["frames"]
        ]
        names = tuple(document["jointSequence"])
    else:
        rows, names = document["poses"], tuple(document["joint_sequence"])
    poses = [[number for part in _parts(np.array(row)) for number in mirrored(part)] for row in rows]
    return names, np.array(poses)


def positions(rig: Sequence[Node], names: Sequence[str], poses: Array) -> dict[str, Array]:
    """Return the position of each node in each frame, by forward kinematics; joints without a channel are at rest."""
    places: dict[str, Array] = {}
    turns: dict[str, Array] = {}
    for node in _depth_first(rig):
        local = np.tile(_matrix(np.array(node.rotation)), (len(poses), 1, 1))
        if node.name in names:
            start = 3 + 4 * list(names).index(node.name)
            local = np.array([_matrix(pose[start : start + 4]) for pose in poses])
        if node.parent is None:
            places[node.name], turns[node.name] = poses[:, :3] + node.offset, local
        else:
            places[node.name] = places[node.parent] + turns[node.parent] @ np.array(node.offset)
            turns[node.name] = turns[node.parent] @ local
    return places


def _matrix(quaternion: Array) -> Array:
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


# Models


def model_poses(document: Mapping[str, Any], scores: Array) -> Array:
    """Evaluate the spatial part of a model of layout 3 or 2 at its canonical frames: poses, unnormalised."""
    space = document.get("sspm") or {
        "mean": document["mean_spatial_vector"], "eigen": document["eigen_vectors_spatial"],
        "n_coeffs": document["n_basis_spatial"], "knots": document["b_spline_knots_spatial"],
    }  # fmt: skip
    coefficients = (np.array(space["mean"]) + scores @ np.array(space["eigen"])).reshape(space["n_coeffs"], -1)
    knots = np.array(space["knots"])
    poses = BSpline(knots, coefficients, 3)(np.arange(round(knots[-1]) + 1))
    poses[:, :3] *= document.get("translation_maxima", [1, 1, 1])
    return np.asarray(poses)


def model_times(document: Mapping[str, Any], scores: Array) -> Array:
    """Evaluate the time function of a model of layout 3 or 2: the frame of the motion at each canonical frame."""
    time = document.get("tspm") or {
        "mean": document["mean_time_vector"], "eigen": document["eigen_vectors_time"],
        "knots": document["b_spline_knots_time"],
    }  # fmt: skip
    mean, eigen, knots = (np.array(time[name], dtype=float) for name in ("mean", "eigen", "knots"))
    frames = np.arange(round(knots[-1]) + 1)
    if eigen.ndim == 2 and len(eigen) == len(mean) != eigen.shape[1]:  # columns: the oldest training program
        steps = np.exp(BSpline(knots, mean + eigen @ scores, 3)(frames[1:]))
        return np.concatenate(([0.0], np.cumsum(steps)))
    logarithms = mean + (scores @ eigen if eigen.size else 0.0)
    times = BSpline(knots, np.cumsum(np.exp(logarithms)) - 1.0, 3)(frames)
    return np.asarray(times - times[0])


# Files


def encode(document: Mapping[str, Any], name: str) -> bytes:
    """Encode a document in the encoding that the ending of the file name states."""
    if name.endswith((".bson", ".bson.bz2")):
        blob: bytes = bson.encode(dict(document))
        return bz2.compress(blob) if name.endswith("bz2") else blob
    return json.dumps(document, indent=1).encode()


def decode(data: bytes) -> Document:
    """Decode a document in any of the three encodings."""
    if data.startswith(b"BZh"):
        data = bz2.decompress(data)
    document: Document = (
        json.loads(data) if data.lstrip().startswith(b"{") and data.rstrip()[-1:] == b"}" else bson.decode(data)
    )
    return document


# A folder with one of each


def transitions(*places: tuple[str, str, str]) -> Document:
    """Return the transitions to nodes; each node is given by an action, the name of its model, and the model's id."""
    return {
        f"{action}:{number}": {"action_name": action, "model_name": name, "model_id": number}
        for action, name, number in places
    }


def graph() -> Document:
    """Return a graph over the models of `folder`."""
    return {
        "nodes": {
            "idle": {"21": {"name": "stand", "type": "idle",
                            "transitions": transitions(("idle", "stand", "21"), ("walk", "begin", "22"))}},
            "walk": {
                "22": {"name": "begin", "type": "start", "transitions": transitions(("walk", "left", "23"))},
                "23": {"name": "left", "type": "standard",
                       "transitions": transitions(("walk", "right", "24"), ("walk", "old", "25"))},
                "24": {"name": "right", "type": "standard", "transitions": transitions(("walk", "left", "23"))},
                "25": {"name": "old", "type": "end", "transitions": transitions(("idle", "stand", "21"))},
            },
        },
        "start_node": ["idle", "stand"],
    }  # fmt: skip


def graph_of_one(name: str) -> Document:
    """Return a graph with one node, an idle state whose model is called `name`."""
    node = {"name": name, "type": "idle", "transitions": transitions(("idle", name, "21"))}
    return {"nodes": {"idle": {"21": node}}, "start_node": ["idle", name]}


TIME_FUNCTION = [min(47, int(1.2 * place)) for place in range(40)]
"""Source frame of each canonical frame of the aligned clip."""
SECTIONS: dict[str, Document] = {
    "walk_sections.json": {"sections": [{"start_idx": 0, "end_idx": 19}, {"start_idx": 20, "end_idx": -1}]},
    "turn_sections.json": {
        "sections": {"left": [{"start_idx": 0, "end_idx": 10}, {"start_idx": 20, "end_idx": 40}],
                     "right": [{"start_idx": 10, "end_idx": 20}]},
    },
    "run_sections.json": {"semantic_annotation": {"contact": [3, 4, 5, 11], "swing": [5, 6, 7]}},
    "walk_aligned_alignment.json": {
        "sections": [{"start_idx": 0, "end_idx": 20}, {"start_idx": 20, "end_idx": -1}],
        "time_function": json.dumps(TIME_FUNCTION),
    },
}  # fmt: skip
"""Annotations of the clips of `folder`.

Sections of `walk` include their end frames, sections of `turn` do not; labels of `run` overlap.
"""


def cluster_tree() -> Document:
    """Return a tree whose root lists no samples, as the predecessor's builder writes it."""
    tree = models.tree()
    tree["root"]["indices"] = None
    return tree


def clips() -> dict[str, Document]:
    """Return a clip in each form, by the name of its file."""
    return {
        "walk.bson.bz2": clip(poses_of(40, 1)),
        "turn.bson": clip(poses_of(40, 2), tips=5),
        "run.json": engine_clip(poses_of(40, 3)),
        "walk_aligned.bson.bz2": clip(poses_of(40, 4)),
    }


def primitives() -> dict[str, Document]:
    """Return a model in each layout, by the name of its file."""
    joints = joints_of(RIG)
    on_rig = {"skeleton": file_skeleton()}
    ends = {"contact0": 20, "contact1": 48, "contact2": -1, "contact3": 60}
    return {
        "begin_mm.json": models.layout_3(1, joints) | on_rig | {"keyframes": ends},
        "left_quaternion_mm.bson.bz2": models.layout_2(2, joints) | on_rig,
        "right_mm.json": models.layout_2(3, joints, by_columns=False) | on_rig,
        "old_mm.bson": models.layout_1(4, joints) | on_rig,
        "stand_mm.json": models.static(5, joints) | on_rig,
    }


def folder() -> dict[str, bytes]:
    """Return the files of a folder with a document of each kind, layout and odd form."""
    documents = {
        "body.skeleton": file_skeleton(),
        "body_skeleton_model.json": {"name": "body", "model": skeleton_model()},
        **clips(),
        **SECTIONS,
        **primitives(),
        "begin_cluster_tree.json": cluster_tree(),
        "steps.json": graph(),
    }
    return {name: encode(document, name) for name, document in documents.items()}

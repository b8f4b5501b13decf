"""Documents of Marey's predecessor besides motions: zipped graphs, synthesis inputs, and records of work.

They are written without the readers and writers of Marey, like those of `predecessor_documents`.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from tests.support import predecessor_documents as old
from tests.support import predecessor_models as models

Document = dict[str, Any]
SECRET = "s3cr3t-of-a-bucket"


def job() -> Document:
    """Return the request of a job on a cluster, with the credentials that the predecessor puts into it."""
    return {
        "image_name": "registry.lab/mg:3", "job_name": "train-walk",
        "job_desc": {
            "repo_url": "https://git.lab/mg.git", "exec_dir": "scripts", "command": "python train.py --épocas 20",
            "out_dir": "out", "aws": {"url": "https://s3.lab", "access_key": "AKIA0", "secret_key": SECRET,
                                      "src_bucket": "in", "dst_bucket": "out"},
        },
        "resources": {"n_gpus": 1, "cpu": {"request": 2, "limit": 4}, "memory": {"request": "4Gi", "limit": "8Gi"},
                      "storage": {"request": "1Gi", "limit": "2Gi"}},
        "user": "eva", "token": "eyJ0.eyJ1.c2ln",
    }  # fmt: skip


def transform_run() -> Document:
    """Return the record of a run of a data transform."""
    return {
        "data_transform_id": 2, "exp_name": "walk statistics", "input_skeleton": "custom", "output_skeleton": "custom",
        "output_id": 41, "input_data": [[7, "aligned_motion", False], [3, "aligned_motion", True]], "store_log": True,
        "hparams": {"n_basis_factor": 0.2, "layers": []}, "cluster_config": None, "token": "",
    }  # fmt: skip


def edit_history() -> list[Any]:
    """Return a history of edits, which is a list and no object."""
    return [
        ["rotate_joint", {"joint_name": "LeftArm", "rotation": [0.0, 0.0, 0.0, 1.0], "frame_range": [3, 20]}],
        ["mirror_animation", None],
        ["concatenate", {"clip": [[1.5] * 40] * 60}],
    ]


def synthesis_input() -> Document:
    """Return an input of the offline synthesis; null is a free coordinate."""
    points = [{"position": [0.0, None, 0.0], "orientation": [None] * 3}, {"position": [40.0, None, 350.5]}]
    target = {"position": [30.0, 120.0, 80.0], "orientation": [None, 90.0, None],
              "semanticAnnotation": {"contact0": True}, "time": 1.5}  # fmt: skip
    return {
        "session": "s1", "startPose": {"position": [0.0, 0.0, 0.0], "orientation": [0.0, 90.0, 0.0]},
        "elementaryActions": [
            {"action": "walk", "constraints": [{"joint": "Hips", "trajectoryConstraints": points}]},
            {"action": "pick",
             "constraints": [{"joint": "LeftHand", "keyframeConstraints": [target]}],
             "keyframeAnnotations": [
                 {"keyframe": "contact0",
                  "annotations": [{"event": "attach", "parameters": {"joint": "LeftHand", "target": "box"}}]}]},
        ],
    }  # fmt: skip


ENDS = {"begin": {"contact": 30, "last": "lastFrame"}, "left": {"end": "-1", "half": "middle"}}
"""Keyframes in the file `meta_information.json` of the action `walk` of `zipped_graph`."""


def zipped_graph(*, tree: str = "json", skeleton: str = "json", colon: bool = False) -> bytes:
    """Return a zipped graph of three models.

    Parameters
    ----------
    tree : form of the tree of the model `begin`: "json" or "pickle"
    skeleton : "json" or "bvh"
    colon : whether transitions join action and model by a colon, as later versions do
    """
    at = ":" if colon else "_"
    definition = {
        "formatVersion": 4 if colon else 2,
        "usePickle": tree == "pickle",
        "transitions": {
            f"idle{at}stand": [f"idle{at}stand", f"walk{at}begin"],
            f"walk{at}begin": {f"walk{at}left": {}},
            f"walk{at}left": [f"idle{at}stand"],
        },
        "actionDefinitions": {
            "walk": {"node_sequence": [], "constraint_slots": {"contact": {"node": "begin", "joint": "LeftHand"}}},
            "idle": {"node_sequence": [["stand", "idle"]], "constraint_slots": {}},
        },
        "startNode": ["idle", "stand"],
        "hand_pose_info": {},
    }
    ends = {"keyframes": {"contact0": 20}}
    joints = old.joints_of(old.RIG)
    without_skeleton = {name: one for name, one in models.layout_2(12, joints).items() if name != "skeleton"}
    rig = old.RIG if skeleton == "json" else BVH_RIG
    on_rig = {"skeleton": old.file_skeleton(rig)}
    walk, idle = ("elementary_action_models/elementary_action_" + action for action in ("walk", "idle"))
    members: dict[str, Any] = {
        "graph_definition.json": definition,
        f"{walk}/walk_begin_quaternion_mm.json": models.layout_3(11, joints) | on_rig | ends,
        f"{walk}/walk_left_quaternion_mm.json": without_skeleton,
        f"{walk}/meta_information.json": {
            "start_states": ["begin"], "end_states": ["left"], "idle_states": [], "cycle_states": [],
            "annotations": ENDS, "annotation_regions": {}, "stats": {},
        },
        f"{idle}/idle_stand_quaternion_mm.json": models.static(13, joints) | on_rig,
        f"{idle}/meta_information.json": {"start_states": [], "end_states": [], "idle_states": ["stand"]},
    }  # fmt: skip
    if skeleton == "json":
        members["skeleton.json"] = old.file_skeleton(model=old.skeleton_model())
    else:
        members["skeleton.bvh"] = bvh()
    if tree == "json":
        members[f"{walk}/walk_begin_quaternion_cluster_tree.json"] = old.cluster_tree()
    else:
        members[f"{walk}/walk_begin_quaternion_cluster_tree.pck"] = b"\x80\x04N."
    return zipped(members)


def zipped(members: Mapping[str, Any]) -> bytes:
    """Return a ZIP archive; members that are not bytes are written as JSON."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as written:
        for name, member in members.items():
            data = member if isinstance(member, bytes) else json.dumps(member).encode()
            written.writestr(zipfile.ZipInfo(name, (2019, 11, 14, 0, 0, 0)), data, zipfile.ZIP_DEFLATED)
    return archive.getvalue()


BVH_RIG = tuple(replace(node, rotation=(1.0, 0.0, 0.0, 0.0)) for node in old.RIG)
"""The rig as BVH files contain it: without rotations of the rest pose."""


def bvh() -> bytes:
    """Return `BVH_RIG` as a BVH file with two frames."""
    lines, channels = ["HIERARCHY"], 0

    def write(node: old.Node, level: int) -> None:
        nonlocal channels
        children = [one for one in BVH_RIG if one.parent == node.name]
        pad = "\t" * level
        head = f"ROOT {node.name}" if level == 0 else f"JOINT {node.name}" if children else "End Site"
        lines.extend([pad + head, pad + "{", pad + "\tOFFSET " + " ".join(map(str, node.offset))])
        if children:
            places = ["Xposition", "Yposition", "Zposition"] if level == 0 else []
            names = [*places, "Zrotation", "Xrotation", "Yrotation"]
            channels += len(names)
            lines.append(f"{pad}\tCHANNELS {len(names)} {' '.join(names)}")
        for one in children:
            write(one, level + 1)
        lines.append(pad + "}")

    write(BVH_RIG[0], 0)
    row = " ".join(["0", "92", "0", *["0"] * (channels - 3)])
    return "\n".join([*lines, "MOTION", "Frames: 2", "Frame Time: 0.033333", row, row, ""]).encode()


def records() -> dict[str, bytes]:
    """Return a record of each kind, by the name of its file."""
    documents: dict[str, Any] = {
        "train_job.json": job(), "statistics_run.bson": transform_run(), "begin_history.json": edit_history(),
        "fetch_input.json": synthesis_input(),
    }  # fmt: skip
    return {
        name: json.dumps(one, indent=2).encode() if isinstance(one, list) else old.encode(one, name)
        for name, one in documents.items()
    }


ZIPPED = "grasp.mg.zip"


def folder() -> dict[str, bytes]:
    """Return the files of a folder with one document of each kind: `predecessor_documents`, records, and a graph."""
    return {**old.folder(), **records(), ZIPPED: zipped_graph()}

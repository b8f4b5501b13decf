"""Skeleton documents of Marey's predecessor: the form in the database, and the form inside files and models.

The database form lists joints (`jointDescs`) and is mirrored in x, like the predecessor's clips. The file form
nests nodes under `root` and is right-handed. Both are in centimetres. Nodes without children are tips of chains, not
joints.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import FormatError, FormatLimit
from marey_motion.formats.document_fields import field_of, number_list, text_list
from marey_motion.importing.source import SourceMotion
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.skeletons import MAX_JOINTS

FORMAT = "predecessor"
CENTIMETRE_M = 0.01
SkeletonForm = Literal["database", "file"]
Document = dict[str, Any]
MIRROR_VECTOR = np.array([-1.0, 1.0, 1.0])
MIRROR_ROTATION = np.array([-1.0, -1.0, 1.0, 1.0])
_ROOT_NODE, _JOINT_NODE, _TIP_NODE = 0, 1, 2
_POSITIONS = ["Xposition", "Yposition", "Zposition"]
_ROTATIONS = ["Xrotation", "Yrotation", "Zrotation"]


def read_skeleton_document(document: Document, file: str) -> SourceMotion:
    """Read a skeleton document of either form.

    Parameters
    ----------
    document : dict    the document
    file : str    name of the file, for messages

    Returns
    -------
    SourceMotion    in centimetres, without motion

    Raises
    ------
    FormatError    naming the invalid field and its node
    """
    if isinstance(document.get("jointDescs"), list):
        nodes, mirrored = _listed_nodes(document, file), True
    elif isinstance(document.get("root"), dict):
        nodes, mirrored = _nested_nodes(document["root"], file), False
    else:
        raise FormatError(
            "the document is neither a clip, which has a field 'poses' or 'frames', nor a skeleton, which "
            "has a field 'jointDescs' or 'root'; of the predecessor's documents, Marey imports clips, skeletons, "
            "skeleton models, annotations, aligned clips, models, their trees, graphs, and records of jobs, "
            "transforms, edits and synthesis inputs",
            code="document-unknown",
            file=file,
        )
    return _source(nodes, mirrored, file)


def skeleton_document(
    skeleton: Skeleton, *, form: SkeletonForm = "database", model: Document | None = None
) -> Document:
    """Convert a skeleton to the form of the predecessor's database or files.

    Every leaf joint gets a tip as child, since a leaf of the document would be read as a tip.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    form : str    "database" or "file"
    model : dict, optional    skeleton model, which only the form "file" contains

    Returns
    -------
    dict    the document, in centimetres
    """
    tips = _tips(skeleton)
    if form == "database":
        return _listed_document(skeleton, tips)
    return {**_nested_document(skeleton, tips), "skeleton_model": model}


# Reading


def _listed_nodes(document: Document, file: str) -> list[tuple[str, str | None, Document]]:
    """List name, name of the parent, and content of each node, depth first, from the list `jointDescs`."""
    listed: dict[str, Document] = {}
    parents: dict[str, str] = {}
    for node in document["jointDescs"]:
        name = field_of(node, "name", str, file)
        if name in listed:
            raise FormatError("jointDescs contains this joint twice; remove one entry", file=file, joint=name)
        listed[name] = node
        for child in text_list(node, "children", file):
            if child in parents:
                raise FormatError(
                    "two joints list this joint as their child; remove it from one of them", file=file, joint=child
                )
            parents[child] = name
    unknown = next((child for child in parents if child not in listed), None)
    roots = [name for name in listed if name not in parents]
    if unknown is not None or len(roots) != 1:
        problem = f"jointDescs has no entry for {unknown!r}" if unknown else f"{len(roots)} joints have no parent"
        raise FormatError(f"the joints are not a tree: {problem}", file=file)
    nodes: list[tuple[str, str | None, Document]] = []
    waiting = [roots[0]]
    while waiting:
        name = waiting.pop()
        nodes.append((name, parents.get(name), listed[name]))
        waiting.extend(reversed(text_list(listed[name], "children", file)))
    if len(nodes) != len(listed):
        below = {name for name, _, _ in nodes}
        raise FormatError(
            f"the joints are not a tree: this joint is its own ancestor or below such a joint, and not below the root "
            f"{roots[0]!r}; correct the lists `children`",
            file=file,
            joint=next(name for name in listed if name not in below),
        )
    return nodes


def _nested_nodes(root: Document, file: str) -> list[tuple[str, str | None, Document]]:
    """List name, name of the parent, and content of each node, depth first, from nested nodes."""
    nodes: list[tuple[str, str | None, Document]] = []
    waiting: list[tuple[Any, str | None]] = [(root, None)]
    while waiting:
        node, parent = waiting.pop()
        name = field_of(node, "name", str, file)
        nodes.append((name, parent, node))
        children = node.get("children") or []
        if not isinstance(children, list):
            raise FormatError("field 'children' must be a list of nodes", file=file, joint=name)
        waiting.extend((child, name) for child in reversed(children))
    return nodes


def _source(nodes: list[tuple[str, str | None, Document]], mirrored: bool, file: str) -> SourceMotion:
    if len(nodes) > 2 * MAX_JOINTS:
        raise FormatLimit(
            f"the skeleton has {len(nodes)} joints and tips, more than twice the limit of {MAX_JOINTS} joints; remove "
            "joints from the skeleton",
            file=file,
        )
    inner = {parent for _, parent, _ in nodes if parent is not None} | {nodes[0][0]}
    indices: dict[str, int] = {}
    parents, offsets, rotations, tips = [], [], [], []
    for name, parent, node in nodes:
        offset = number_list(node, "offset", 3, file, name) * (MIRROR_VECTOR if mirrored else 1.0)
        if name in indices:
            raise FormatError("two joints have this name; rename one of them", file=file, joint=name)
        if name not in inner:
            tips.append((indices[str(parent)], offset))
            continue
        rotation = number_list(node, "rotation", 4, file, name) * (MIRROR_ROTATION if mirrored else 1.0)
        length = float(np.linalg.norm(rotation))
        if length < 1e-6:
            raise FormatError(
                "all four numbers of the rotation are zero; it must be a quaternion w, x, y, z", file=file, joint=name
            )
        parents.append(-1 if parent is None else indices[parent])
        offsets.append(offset)
        rotations.append(rotation / length if abs(length - 1.0) > 1e-12 else rotation)
        indices[name] = len(indices)
    return SourceMotion(
        format=FORMAT,
        joint_names=tuple(indices),
        display_names=tuple(indices),
        parents=np.array(parents, np.int32),
        offsets=np.array(offsets),
        rest_rotations=np.array(rotations),
        end_sites=tuple(tips),
        unit_scale_m=CENTIMETRE_M,
        up_axis="y",
    )


def source_of_skeleton(skeleton: Skeleton) -> SourceMotion:
    """Convert a skeleton to the content of a skeleton document.

    Parameters
    ----------
    skeleton : Skeleton    J joints

    Returns
    -------
    SourceMotion    in centimetres, without motion; `display_names` are the names of the joints in their file
    """
    return SourceMotion(
        format=FORMAT,
        joint_names=skeleton.joint_names,
        display_names=skeleton.display_names or skeleton.joint_names,
        parents=skeleton.parents,
        offsets=skeleton.offsets / CENTIMETRE_M,
        rest_rotations=skeleton.rest_rotations,
        end_sites=tuple((site.joint, site.offset / CENTIMETRE_M) for site in skeleton.end_sites),
        unit_scale_m=CENTIMETRE_M,
        up_axis="y",
    )


# Writing


def _tips(skeleton: Skeleton) -> list[tuple[str, int, NDArray[np.float64]]]:
    """List (name, joint, offset in metres) of every tip; a leaf joint without an end site gets a tip with offset 0."""
    sites = [(site.joint, site.offset) for site in skeleton.end_sites]
    ended = {joint for joint, _ in sites}
    sites += [(j, np.zeros(3)) for j, children in enumerate(skeleton.children) if not children and j not in ended]
    taken = set(skeleton.joint_names)
    tips = []
    for joint, offset in sites:
        name, number = f"{skeleton.joint_names[joint]}_EndSite", 2
        while name in taken:
            name, number = f"{skeleton.joint_names[joint]}_EndSite{number}", number + 1
        taken.add(name)
        tips.append((name, joint, offset))
    return tips


def _listed_document(skeleton: Skeleton, tips: list[tuple[str, int, NDArray[np.float64]]]) -> Document:
    names = skeleton.joint_names
    offsets = skeleton.offsets / CENTIMETRE_M * MIRROR_VECTOR
    rotations = skeleton.rest_rotations * MIRROR_ROTATION
    descriptions: list[Document] = []
    for joint, name in enumerate(names):
        children = [names[child] for child in skeleton.children[joint]]
        children += [tip for tip, owner, _ in tips if owner == joint]
        descriptions.append(_described(name, offsets[joint], rotations[joint], children))
    for name, _, offset in tips:
        descriptions.append(
            _described(name, offset / CENTIMETRE_M * MIRROR_VECTOR, np.array([-1.0, 0.0, 0.0, 0.0]), [])
        )
    return {
        "root": names[0],
        "jointDescs": descriptions,
        "jointSequence": list(names),
        "referencePose": {
            "rotations": [dict(zip("wxyz", rotation, strict=True)) for rotation in rotations.tolist()],
            "translations": [dict(zip("xyz", offset, strict=True)) for offset in offsets.tolist()],
        },
    }


def _described(name: str, offset: NDArray[np.float64], rotation: NDArray[np.float64], children: list[str]) -> Document:
    return {
        "name": name,
        "offset": offset.tolist(),
        "rotation": rotation.tolist(),
        "targetName": name,
        "children": children,
    }


def _nested_document(skeleton: Skeleton, tips: list[tuple[str, int, NDArray[np.float64]]]) -> Document:
    offsets = skeleton.offsets / CENTIMETRE_M
    nodes: list[Document] = []
    for joint, name in enumerate(skeleton.joint_names):
        parent = int(skeleton.parents[joint])
        above = nodes[parent] if parent >= 0 else None
        node = _nested_node(name, joint, above, offsets[joint], skeleton.rest_rotations[joint])
        node["quaternion_frame_index"] = joint
        node["channels"] = _ROTATIONS if above else _POSITIONS + _ROTATIONS
        node["node_type"] = _JOINT_NODE if above else _ROOT_NODE
        nodes.append(node)
    for number, (name, joint, offset) in enumerate(tips, len(nodes)):
        node = _nested_node(name, number, nodes[joint], offset / CENTIMETRE_M, np.array([1.0, 0.0, 0.0, 0.0]))
        node |= {"quaternion_frame_index": -1, "channels": [], "fixed": True, "node_type": _TIP_NODE}
    return {
        "animated_joints": list(skeleton.joint_names),
        "free_joints_map": {},
        "skeleton_model": None,
        "frame_time": 1.0 / 30.0,
        "root": nodes[0],
        "tool_nodes": [],
        "aligning_root_node": skeleton.joint_names[0],
    }


def _nested_node(
    name: str, index: int, above: Document | None, offset: NDArray[np.float64], rotation: NDArray[np.float64]
) -> Document:
    """Make the node of a joint or tip, and add it to the children of the node `above`, if there is one."""
    node: Document = {
        "name": name,
        "parent": above["name"] if above else None,
        "index": index,
        "offset": offset.tolist(),
        "rotation": rotation.tolist(),
        "fixed": False,
        "level": above["level"] + 1 if above else 0,
        "children": [],
    }
    if above:
        above["children"].append(node)
    return node

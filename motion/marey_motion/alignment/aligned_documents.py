"""Conversion of aligned examples to and from trees of plain values and arrays, with one tree per example."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from marey_motion.alignment.aligned import AlignedClip, AlignedSet, Placement, Recording
from marey_motion.alignment.aligning import MIRRORED, restore
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.motion import Motion

ALIGNMENT_SCHEMA = "marey/alignment@1"

Tree = dict[str, Any]

SHARED = ("set", "reference", "keyframes")
"""Fields of the tree of an example that have the same value in all examples of one set."""


class StoredExample(NamedTuple):
    """Stored form of an aligned example: its frames as a clip, and all other data as a tree of values and arrays.

    Parameters
    ----------
    uid : str    uid of the example, used if `info` contains none
    clip : Clip    canonical frames of the example
    info : mapping    the tree made by `example_to_tree`
    """

    uid: str
    clip: Clip
    info: Mapping[str, Any]


def uid_of(item: str, revision: int, *, mirrored: bool = False) -> str:
    """Make the uid of a stored clip in an aligned set.

    Parameters
    ----------
    item : str    id of the clip
    revision : int    revision of the clip
    mirrored : bool    whether the uid is for the clip's mirrored copy

    Returns
    -------
    str    "item@revision", with `~mirrored` for a mirrored copy
    """
    return f"{item}@{revision}{MIRRORED if mirrored else ''}"


def example_to_tree(
    aligned: AlignedSet, example: AlignedClip, *, digest: str | None = None, options: Tree | None = None
) -> Tree:
    """Convert one example of a set to a tree, which is stored with the example as the part `info`.

    All uids of the set must come from `uid_of`.

    Parameters
    ----------
    aligned : AlignedSet    the set
    example : AlignedClip    one of its clips
    digest : str, optional    digest of the whole set
    options : dict, optional    options of the alignment

    Returns
    -------
    dict    plain values and arrays
    """
    placement = example.placement
    return {
        "schema": ALIGNMENT_SCHEMA,
        "name": example.name,
        "clip": _reference_of(example.uid),
        "take": example.recording.take or None,
        "subject": example.recording.subject or None,
        "reference": _reference_of(aligned.reference),
        "set": digest,
        "frame_rate_hz": aligned.frame_rate_hz,
        "source_frames": example.source_frames,
        "time_function": np.ascontiguousarray(example.time_function, dtype=np.float64),
        "placement": {
            "heading_rad": placement.heading_rad,
            "x": placement.x,
            "y": placement.y,
            "z": placement.z,
            "joint": aligned.skeleton.joint_names[placement.joint],
        },
        "keyframes": dict(aligned.keyframes),
        "cost": example.cost,
        "options": options,
    }


def set_from_examples(examples: Sequence[StoredExample]) -> AlignedSet:
    """Assemble a set from stored examples, ordered by name and uid; some examples of the original set may be missing.

    Parameters
    ----------
    examples : sequence of StoredExample    examples of one alignment

    Returns
    -------
    AlignedSet    the set

    Raises
    ------
    MotionError    if there are no examples, or if an example belongs to another set, has another skeleton or is
        repeated; the error names the example
    """
    if not examples:
        raise MotionError("no aligned clips were given; choose at least one", code="too-few-clips")
    clips = sorted((_example(one) for one in examples), key=lambda clip: (clip.name, clip.uid))
    first = examples[0]
    for one in examples[1:]:
        _require_same_set(first, one)
    for before, after in pairwise(clips):
        if before.uid == after.uid:
            raise MotionError(
                "the set of clips contains this clip twice; leave one of the two out",
                code="sets-differ",
                where=after.name,
            )
    reference = first.info.get("reference")
    return AlignedSet(
        skeleton=first.clip.skeleton,
        frame_rate_hz=float(first.info["frame_rate_hz"]),
        clips=tuple(clips),
        reference=_uid(reference) if reference else "",
        keyframes=dict(first.info.get("keyframes") or {}),
    )


def restored_clip(clip: Clip, info: Mapping[str, Any]) -> Clip:
    """Restore the source clip of a stored example: its timing and position, at the frame rate of the aligned set.

    Parameters
    ----------
    clip : Clip    the canonical frames
    info : mapping    the tree made by `example_to_tree`

    Returns
    -------
    Clip    the source at the frame rate of the set

    Raises
    ------
    MotionError    if the frame count or the frame rate of the clip differs from that in `info`
    """
    example = _example(StoredExample("", clip, info))
    return restore(example, clip.skeleton).as_clip(clip.skeleton, clip.frame_rate_hz)


def _example(stored: StoredExample) -> AlignedClip:
    clip, info = stored.clip, stored.info
    name = str(info.get("name") or stored.uid)
    times = np.asarray(info["time_function"], dtype=np.float64)
    if len(times) != clip.frame_count or info["frame_rate_hz"] != clip.frame_rate_hz:
        raise MotionError(
            f"the clip has {clip.frame_count} frames at {clip.frame_rate_hz:g} Hz, but its time function has "
            f"{len(times)} frames at {info['frame_rate_hz']:g} Hz; align the clips again",
            code="alignment-invalid",
            where=name,
        )
    placement = dict(info.get("placement") or {})
    joint = placement.pop("joint", None)
    return AlignedClip(
        uid=_uid(info["clip"]) if info.get("clip") else stored.uid,
        name=name,
        motion=Motion.of(clip),
        time_function=times,
        placement=Placement(
            heading_rad=placement.get("heading_rad", 0.0),
            x=placement.get("x", 0.0),
            z=placement.get("z", 0.0),
            y=placement.get("y", 0.0),
            joint=0 if joint is None else clip.skeleton.index_of(joint),
        ),
        cost=float(info.get("cost", 0.0)),
        source_frames=int(info["source_frames"]),
        recording=_recording(info),
    )


def _recording(info: Mapping[str, Any]) -> Recording:
    """Read take and performer from the tree of an example; if it names no take, the clip counts as its own take."""
    clip = info.get("clip") or {}
    return Recording(str(info.get("take") or clip.get("item") or ""), str(info.get("subject") or ""))


def _require_same_set(first: StoredExample, one: StoredExample) -> None:
    name = str(one.info.get("name") or one.uid)
    if one.clip.skeleton.joint_names != first.clip.skeleton.joint_names:
        raise MotionError(
            "the clip has a different skeleton from the other clips; retarget it first",
            code="skeleton-mismatch",
            where=name,
        )
    same_frames = (one.clip.frame_count, one.clip.frame_rate_hz) == (first.clip.frame_count, first.clip.frame_rate_hz)
    if not same_frames or any(one.info.get(key) != first.info.get(key) for key in SHARED):
        raise MotionError(
            "the clip was not aligned together with the other clips; align all of them in one job",
            code="sets-differ",
            where=name,
        )


def _reference_of(uid: str) -> Tree:
    name = uid.removesuffix(MIRRORED)
    item, _, revision = name.rpartition("@")
    return {"item": item, "revision": int(revision), "mirrored": name != uid}


def _uid(reference: Mapping[str, Any]) -> str:
    return uid_of(reference["item"], reference["revision"], mirrored=bool(reference.get("mirrored")))

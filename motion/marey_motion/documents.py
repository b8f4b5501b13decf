"""Conversion of skeletons, mappings, clips and annotations to and from documents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.editing.annotations.layers import Keyframe, Layer, Segment
from marey_motion.errors import ClipError, MappingError
from marey_motion.rigs import STANDARD_JOINTS, JointAxes, JointMapping, map_joints, require_trust
from marey_motion.skeleton import EndSite, Skeleton
from marey_schemas.documents import annotations as annotation_documents
from marey_schemas.documents import clips, skeletons
from marey_schemas.documents.references import OutputRef, RevisionRef


def skeleton_to_document(skeleton: Skeleton) -> skeletons.SkeletonHierarchy:
    """Convert a skeleton to a `hierarchy` document, which stores the joints of a skeleton.

    Parameters
    ----------
    skeleton : Skeleton    J joints

    Returns
    -------
    SkeletonHierarchy    the document, in metres
    """
    joints = tuple(
        skeletons.Joint(
            name=name,
            parent=int(parent),
            offset=tuple(offset.tolist()),
            rest_rotation=tuple(rotation.tolist()),
            display_name=None if display == name else display,
        )
        for name, display, parent, offset, rotation in zip(
            skeleton.joint_names,
            skeleton.display_names,
            skeleton.parents,
            skeleton.offsets,
            skeleton.rest_rotations,
            strict=True,
        )
    )
    sites = tuple(
        skeletons.EndSiteDocument(joint=site.joint, offset=tuple(site.offset.tolist())) for site in skeleton.end_sites
    )
    return skeletons.SkeletonHierarchy(joints=joints, end_sites=sites)


def skeleton_from_document(document: skeletons.SkeletonHierarchy) -> Skeleton:
    """Convert a `hierarchy` document to a skeleton.

    Parameters
    ----------
    document : SkeletonHierarchy    the document

    Returns
    -------
    Skeleton    J joints

    Raises
    ------
    SkeletonError    if the document is not a valid skeleton
    """
    return Skeleton(
        joint_names=tuple(joint.name for joint in document.joints),
        parents=np.array([joint.parent for joint in document.joints], dtype=np.int32),
        offsets=np.array([joint.offset for joint in document.joints], dtype=np.float64),
        rest_rotations=np.array([joint.rest_rotation for joint in document.joints], dtype=np.float64),
        end_sites=tuple(EndSite(site.joint, np.array(site.offset)) for site in document.end_sites),
        display_names=tuple(joint.display_name or joint.name for joint in document.joints),
    )


def clip_to_document(clip: Clip, skeleton: RevisionRef | OutputRef) -> clips.MotionDocument:
    """Convert a clip to a `motion` document, which stores the frames of a clip.

    Parameters
    ----------
    clip : Clip    F frames
    skeleton : RevisionRef or OutputRef    reference to the stored skeleton of the clip

    Returns
    -------
    MotionDocument    the document, with the joints' names and order
    """
    names = clip.skeleton.joint_names
    return clips.MotionDocument(
        skeleton=skeleton,
        frame_rate_hz=clip.frame_rate_hz,
        joints=names,
        poses=np.ascontiguousarray(clip.poses),
        translations=None if clip.translations is None else np.ascontiguousarray(clip.translations),
        translated_joints=tuple(names[joint] for joint in clip.translated_joints),
    )


def clip_to_tree(clip: Clip, skeleton: Mapping[str, Any]) -> dict[str, Any]:
    """Convert a clip to the content of a `motion` document, as plain values and arrays, without validation.

    Parameters
    ----------
    clip : Clip    poses in metres and unit quaternions
    skeleton : mapping    reference to the stored skeleton

    Returns
    -------
    dict    the same content as the document of `clip_to_document`
    """
    names = clip.skeleton.joint_names
    tree = {
        "schema": "marey/motion@1",
        "skeleton": dict(skeleton),
        "frame_rate_hz": float(clip.frame_rate_hz),
        "joints": names,
        "poses": np.ascontiguousarray(clip.poses),
        "translated_joints": tuple(names[joint] for joint in clip.translated_joints),
    }
    if clip.translations is not None:
        tree["translations"] = np.ascontiguousarray(clip.translations)
    return tree


def clip_from_document(document: clips.MotionDocument, skeleton: Skeleton) -> Clip:
    """Convert a `motion` document to a clip, with the rotations in the order of the skeleton's joints.

    Parameters
    ----------
    document : MotionDocument    the document
    skeleton : Skeleton    the skeleton to which the document refers

    Returns
    -------
    Clip    F frames

    Raises
    ------
    ClipError    if the document belongs to another skeleton or its numbers are not a valid motion
    """
    if set(document.joints) != set(skeleton.joint_names) or len(document.joints) != skeleton.joint_count:
        odd = sorted(set(document.joints) ^ set(skeleton.joint_names)) or ["a repeated name"]
        raise ClipError(
            f"the motion and the skeleton must have the same joints, but only one of the two has {', '.join(odd[:5])}",
            where="joints",
        )
    if document.joints[0] != skeleton.joint_names[0]:
        raise ClipError(
            f"the first joint of the motion must be {skeleton.joint_names[0]}, the root of the skeleton", where="joints"
        )
    poses, translations = document.poses, document.translations
    if document.joints != skeleton.joint_names:
        place = {name: index for index, name in enumerate(document.joints)}
        order = [place[name] for name in skeleton.joint_names]
        rotations = poses[:, 3:].reshape(len(poses), -1, 4)[:, order]
        poses = np.concatenate((poses[:, :3], rotations.reshape(len(poses), -1)), axis=1)
    translated = [skeleton.index_of(name) for name in document.translated_joints]
    if translations is not None and translated != sorted(translated):
        order = np.argsort(translated).tolist()
        translated = [translated[index] for index in order]
        translations = translations[:, order]
    return Clip(skeleton, document.frame_rate_hz, poses, translations, tuple(translated))


def layer_to_document(
    layer: Layer,
    clip: RevisionRef | OutputRef,
    name: str,
    made_by: Literal["person", "algorithm"] = "person",
) -> annotation_documents.Annotation:
    """Convert an annotation layer to an `annotation` document.

    Parameters
    ----------
    layer : Layer    segments and keyframes
    clip : RevisionRef or OutputRef    reference to the stored clip that is annotated
    name : str    name of the layer
    made_by : str    "person" or "algorithm"

    Returns
    -------
    Annotation    the document
    """
    return annotation_documents.Annotation(
        clip=clip,
        layer=name,
        made_by=made_by,
        segments=tuple(annotation_documents.SegmentDocument(**segment._asdict()) for segment in layer.segments),
        keyframes=tuple(annotation_documents.KeyframeDocument(**keyframe._asdict()) for keyframe in layer.keyframes),
    )


def layer_from_document(document: annotation_documents.Annotation, frame_count: int) -> Layer:
    """Convert an `annotation` document to a layer.

    Parameters
    ----------
    document : Annotation    the document
    frame_count : int    frames of the annotated clip

    Returns
    -------
    Layer    segments and keyframes

    Raises
    ------
    AnnotationError    if a segment or keyframe is outside the clip
    """
    return Layer(
        frame_count,
        tuple(Segment(one.label, one.start, one.end) for one in document.segments),
        tuple(Keyframe(one.label, one.frame) for one in document.keyframes),
    )


def mapping_to_document(mapping: JointMapping, axes: Mapping[str, JointAxes]) -> skeletons.SkeletonMapping:
    """Convert a joint mapping and the axes of its joints to a `mapping` document.

    Parameters
    ----------
    mapping : JointMapping    joint names by standard name
    axes : mapping of str to JointAxes    axes by joint name

    Returns
    -------
    SkeletonMapping    the document
    """
    return skeletons.SkeletonMapping(
        rig=mapping.rig,
        method=mapping.method,
        confidence=mapping.confidence,
        joints=dict(mapping.joints),
        axes={joint: skeletons.JointAxesDocument(twist=one.twist, swing=one.swing) for joint, one in axes.items()},
        notes=mapping.notes,
    )


def mapping_from_document(
    document: skeletons.SkeletonMapping, skeleton: Skeleton
) -> tuple[JointMapping, dict[str, JointAxes]]:
    """Convert a `mapping` document, which a person may have edited, to a joint mapping and the axes of its joints.

    Axes are normalised, and the swing axis is made perpendicular to the twist axis.

    Parameters
    ----------
    document : SkeletonMapping    the document
    skeleton : Skeleton    the skeleton whose joints are mapped

    Returns
    -------
    mapping : JointMapping    joint names by standard name
    axes : dict of str to JointAxes    axes by joint name

    Raises
    ------
    MappingError    if a standard name is unknown, a joint is missing from the skeleton, or an axis has no direction
    """
    for standard, name in document.joints.items():
        if standard not in STANDARD_JOINTS:
            raise MappingError(
                f"the mapping contains {standard!r}, which is not a standard joint; correct or remove this entry",
                where=f"joints.{standard}",
            )
        if name not in skeleton:
            raise MappingError(
                f"the skeleton has no joint {name!r}; correct or remove this entry", where=f"joints.{standard}"
            )
    for name in document.axes:
        if name not in skeleton:
            raise MappingError(
                f"the skeleton has no joint {name!r}; correct or remove this entry", where=f"axes.{name}"
            )
    axes = {name: _orthonormal(name, one) for name, one in document.axes.items()}
    mapping = JointMapping(
        document.rig, dict(document.joints), document.confidence, document.method, tuple(document.notes)
    )
    return mapping, axes


def trusted_mapping(
    document: skeletons.SkeletonMapping | None, skeleton: Skeleton
) -> tuple[JointMapping, dict[str, JointAxes]]:
    """Convert a `mapping` document as `mapping_from_document` does; find the standard joints if there is no document.

    Parameters
    ----------
    document : SkeletonMapping or None    the document; None if the skeleton has no part `mapping`
    skeleton : Skeleton    the skeleton whose joints are mapped

    Returns
    -------
    mapping : JointMapping    joint names by standard name
    axes : dict of str to JointAxes    axes by joint name; empty if there is no document

    Raises
    ------
    MappingError    if the document contradicts the skeleton, or if the confidence of the mapping is below
        `LEAST_CONFIDENCE`
    """
    mapping, axes = (map_joints(skeleton), {}) if document is None else mapping_from_document(document, skeleton)
    return require_trust(mapping), axes


def _orthonormal(joint: str, axes: skeletons.JointAxesDocument) -> JointAxes:
    twist, swing = np.array(axes.twist), np.array(axes.swing)
    length = float(np.linalg.norm(twist))
    if not 0.0 < length < np.inf:
        raise MappingError("the twist axis must be finite and not zero", where=f"axes.{joint}")
    twist = twist / length
    across = swing - (swing @ twist) * twist
    reach = float(np.linalg.norm(across))
    if not 1e-6 * float(np.linalg.norm(swing)) < reach < np.inf:
        raise MappingError("the swing axis must not be parallel to the twist axis", where=f"axes.{joint}")
    across /= reach
    return JointAxes(_triple(twist), _triple(across))


def _triple(v: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (float(component) for component in v)
    return x, y, z

"""Skeletons, mappings and clips are restored exactly from documents in every encoding."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.support.present import present

from marey_motion import documents
from marey_motion.errors import ClipError, MappingError, SkeletonError
from marey_motion.rigs import guess_axes, map_joints
from marey_motion.skeleton import Skeleton, same_hierarchy
from marey_schemas.documents import clips, skeletons
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.skeletons import SkeletonMapping
from marey_schemas.encoding import codecs

STORED = RevisionRef(item="skeleton-1", revision=3)


@pytest.mark.parametrize("media_type", ["application/json", "application/msgpack", "application/bson"])
def test_a_clip_comes_back_to_the_bit_in_every_media_type(
    body: Skeleton, tumbling: Callable[..., Any], media_type: str
) -> None:
    clip = tumbling(body, translated=(3, 9))
    sent = codecs.encode_tree(documents.clip_to_document(clip, STORED).model_dump(by_alias=True), media_type)
    document = clips.MotionDocument.model_validate(codecs.decode_tree(sent, media_type))
    back = documents.clip_from_document(document, body)

    assert document.skeleton == STORED
    assert back.poses.tobytes() == clip.poses.tobytes()
    assert present(back.translations).tobytes() == clip.translations.tobytes()
    assert (back.frame_rate_hz, back.translated_joints) == (clip.frame_rate_hz, clip.translated_joints)


@pytest.mark.parametrize("stop", [6, 9])
def test_a_slice_of_a_clip_is_a_document_too(body: Skeleton, tumbling: Callable[..., Any], stop: int) -> None:
    part = tumbling(body).sliced(5, stop)
    assert documents.clip_to_document(part, STORED).poses.shape == part.poses.shape


def test_a_skeleton_comes_back_exactly(body: Skeleton) -> None:
    skeleton = replace(body, display_names=("Hips", *["again"] * 21))
    tree = documents.skeleton_to_document(skeleton).model_dump(by_alias=True, mode="json")
    back = documents.skeleton_from_document(skeletons.SkeletonHierarchy.model_validate(tree))

    assert same_hierarchy(back, skeleton)
    assert back.display_names == skeleton.display_names


def test_a_skeleton_whose_rest_rotation_is_none_is_refused(body: Skeleton) -> None:
    document = documents.skeleton_to_document(body)
    joint = document.joints[4].model_copy(update={"rest_rotation": (0.0, 0.0, 0.0, 0.0)})
    broken = document.model_copy(update={"joints": (*document.joints[:4], joint, *document.joints[5:])})

    with pytest.raises(SkeletonError) as caught:
        documents.skeleton_from_document(broken)
    assert caught.value.where == "LeftToeBase"


def test_rotations_in_another_order_find_their_joints(body: Skeleton, tumbling: Callable[..., Any]) -> None:
    clip = tumbling(body, translated=(3, 9))
    document = documents.clip_to_document(clip, STORED)
    order = [0, *range(21, 0, -1)]
    shuffled = document.model_copy(
        update={
            "joints": tuple(body.joint_names[joint] for joint in order),
            "poses": np.concatenate((clip.poses[:, :3], clip.rotations[:, order].reshape(70, -1)), axis=1),
            "translations": clip.translations[:, ::-1],
            "translated_joints": document.translated_joints[::-1],
        }
    )
    back = documents.clip_from_document(shuffled, body)

    np.testing.assert_array_equal(back.poses, clip.poses)
    np.testing.assert_array_equal(back.translations, clip.translations)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda names: ("Pelvis", *names[1:]), "Hips, Pelvis"),
        (lambda names: (names[1], names[0], *names[2:]), "root"),
        (lambda names: (*names[:-1], names[0]), "Head"),
    ],
)
def test_a_motion_of_another_skeleton_is_refused(
    body: Skeleton, tumbling: Callable[..., Any], change: Callable[..., Any], words: str
) -> None:
    document = documents.clip_to_document(tumbling(body), STORED)
    other = document.model_copy(update={"joints": change(document.joints)})

    with pytest.raises(ClipError, match=words):
        documents.clip_from_document(other, body)


def test_a_mapping_comes_back_with_its_axes(body: Skeleton) -> None:
    mapping = map_joints(body)
    axes = guess_axes(body, mapping)
    tree = documents.mapping_to_document(mapping, axes).model_dump(by_alias=True, mode="json")
    back, back_axes = documents.mapping_from_document(skeletons.SkeletonMapping.model_validate(tree), body)

    assert back == mapping
    assert set(back_axes) == set(axes)
    for name, one in axes.items():
        np.testing.assert_allclose(back_axes[name].twist, one.twist, atol=1e-15)
        np.testing.assert_allclose(back_axes[name].swing, one.swing, atol=1e-15)


def edited(
    body: Skeleton, joints: dict[str, str] | None = None, axes: dict[str, dict[str, tuple[int, int, int]]] | None = None
) -> SkeletonMapping:
    return skeletons.SkeletonMapping.model_validate({"joints": joints or {}, "axes": axes or {}})


def test_axes_that_a_person_wrote_are_squared_up(body: Skeleton) -> None:
    document = edited(body, axes={"Hips": {"twist": (0, 2, 0), "swing": (3, 3, 0)}})
    _, axes = documents.mapping_from_document(document, body)

    assert axes["Hips"].twist == (0.0, 1.0, 0.0)
    assert axes["Hips"].swing == (1.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("joints", "axes", "where"),
    [
        ({"left_nose": "Hips"}, None, "joints.left_nose"),
        ({"pelvis": "Pelvis"}, None, "joints.pelvis"),
        (None, {"Pelvis": {"twist": (0, 1, 0), "swing": (1, 0, 0)}}, "axes.Pelvis"),
        (None, {"Hips": {"twist": (0, 0, 0), "swing": (1, 0, 0)}}, "axes.Hips"),
        (None, {"Hips": {"twist": (0, 1, 0), "swing": (0, 2, 0)}}, "axes.Hips"),
        (None, {"Hips": {"twist": (0, 1, 0), "swing": (0, 0, 0)}}, "axes.Hips"),
    ],
)
def test_an_edited_mapping_that_makes_no_sense_says_where(
    body: Skeleton, joints: dict[str, str] | None, axes: dict[str, dict[str, tuple[int, int, int]]] | None, where: str
) -> None:
    with pytest.raises(MappingError) as caught:
        documents.mapping_from_document(edited(body, joints, axes), body)
    assert caught.value.where == where

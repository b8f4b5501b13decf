"""Conversion of aligned sets to documents and back."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.support.alignment_examples import body_of, walk, warped_walks

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.alignment.aligned_documents import StoredExample, example_to_tree, set_from_examples, uid_of
from marey_motion.alignment.aligning import align_clips, restore, with_mirrored
from marey_motion.alignment.segments import Cut
from marey_motion.errors import MotionError
from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.encoding.codecs import JSON, MEDIA_TYPES, decode_tree, encode_tree
from marey_schemas.options.alignment import AlignOptions

BODY = body_of(walk())
DIGEST = f"sha256:{64 * 'a'}"


@pytest.fixture(scope="module")
def aligned() -> AlignedSet:
    examples, warps = warped_walks(3)
    cut = [replace(one, cuts=(Cut(("down",), int(np.argmin(np.abs(warps[one.uid] - 30)))),)) for one in examples]
    return align_clips(with_mirrored(cut, BODY), BODY, AlignOptions(reference="clip_a@1"))


def stored(aligned: AlignedSet, media_type: str = JSON) -> list[StoredExample]:
    """Encode and decode the examples of a set; return them in reverse order."""
    examples = []
    for number, one in enumerate(aligned.clips):
        tree = example_to_tree(aligned, one, digest=DIGEST)
        info = AlignmentInfo.model_validate(decode_tree(encode_tree(tree, media_type), media_type))
        clip = one.motion.as_clip(aligned.skeleton, aligned.frame_rate_hz)
        examples.append(StoredExample(f"processed_{number}@1", clip, info.model_dump(by_alias=True)))
    return examples[::-1]


@pytest.mark.parametrize("media_type", MEDIA_TYPES)
def test_a_set_comes_back_from_its_documents(aligned: AlignedSet, media_type: str) -> None:
    back = set_from_examples(stored(aligned, media_type))
    assert [clip.uid for clip in back.clips] == [clip.uid for clip in aligned.clips]
    assert [clip.name for clip in back.clips] == [clip.name for clip in aligned.clips]
    assert (back.reference, back.frame_rate_hz) == (aligned.reference, aligned.frame_rate_hz)
    assert back.keyframes == aligned.keyframes == {"down": 30}
    assert np.array_equal(back.time_functions, aligned.time_functions)
    for one, other in zip(back.clips, aligned.clips, strict=True):
        assert one.motion.poses == pytest.approx(other.motion.poses, abs=1e-6)
        assert one.placement == other.placement
        assert (one.cost, one.source_frames) == (other.cost, other.source_frames)


def test_an_example_is_restored_from_its_documents_as_from_the_set(aligned: AlignedSet) -> None:
    back = set_from_examples(stored(aligned))
    for one, other in zip(back.clips, aligned.clips, strict=True):
        assert restore(one, back.skeleton).poses == pytest.approx(restore(other, BODY.skeleton).poses, abs=1e-5)


def test_mirrored_examples_tell_the_clip_they_mirror(aligned: AlignedSet) -> None:
    tree = example_to_tree(aligned, aligned.clips[1])
    assert tree["clip"] == {"item": "clip_a", "revision": 1, "mirrored": True}
    assert tree["reference"] == {"item": "clip_a", "revision": 1, "mirrored": False}
    assert uid_of("clip_a", 1, mirrored=True) == aligned.clips[1].uid


def test_some_examples_of_a_set_make_a_set(aligned: AlignedSet) -> None:
    assert len(set_from_examples(stored(aligned)[:2]).clips) == 2


def test_examples_of_unknown_origin_go_by_the_names_they_are_given(aligned: AlignedSet) -> None:
    plain = [one._replace(info={**one.info, "clip": None, "reference": None, "set": None}) for one in stored(aligned)]
    back = set_from_examples(plain)
    assert [clip.uid for clip in back.clips] == sorted(one.uid for one in plain)
    assert back.reference == ""


def changed(aligned: AlignedSet, **info: Any) -> list[StoredExample]:
    examples = stored(aligned)
    return [examples[0], examples[1]._replace(info={**examples[1].info, **info})]


@pytest.mark.parametrize(
    ("info", "said"),
    [
        ({"set": f"sha256:{64 * 'b'}"}, "not aligned together"),
        ({"keyframes": {"down": 31}}, "not aligned together"),
        ({"reference": {"item": "clip_b", "revision": 1, "mirrored": False}}, "not aligned together"),
        ({"frame_rate_hz": 30.0}, "60 frames at 60 Hz, but its time function has 60 frames at 30 Hz"),
        ({"clip": {"item": "clip_c", "revision": 1, "mirrored": True}}, "the set of clips contains this clip twice"),
    ],
)
def test_examples_that_were_not_aligned_together_are_told_apart(
    aligned: AlignedSet, info: dict[str, Any], said: str
) -> None:
    with pytest.raises(MotionError, match=said):
        set_from_examples(changed(aligned, **info))


def test_no_examples_make_no_set() -> None:
    with pytest.raises(MotionError, match="no aligned clips were given"):
        set_from_examples([])


def valid_tree(aligned: AlignedSet) -> dict[str, Any]:
    return example_to_tree(aligned, aligned.clips[0], digest=DIGEST)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"time_function": np.array([0.0, 2.0, 1.0])}, "increase strictly"),
        ({"time_function": np.array([0.0])}, "at least two canonical frames"),
        ({"source_frames": 61}, "from 0 to 60"),
        ({"keyframes": {"down": 60}}, "keyframes.down: frame 60 is outside the 60 canonical frames"),
        ({"cost": -1.0}, "cost"),
        ({"stray": 1}, "stray"),
    ],
)
def test_a_document_that_contradicts_itself_is_refused(aligned: AlignedSet, change: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        AlignmentInfo.model_validate({**valid_tree(aligned), **change})

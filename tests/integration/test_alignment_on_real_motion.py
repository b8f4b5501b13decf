"""Alignment of examples of real actions."""

from pathlib import Path

import numpy as np
import pytest

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.alignment.aligning import SourceExample, align_clips, restore
from marey_motion.formats import read_motion
from marey_motion.kinematics import forward_directions
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.resampling import resample_motion
from marey_motion.rigs import map_joints
from marey_schemas.options.alignment import AlignOptions

RATE_HZ = 30.0


def examples_in(files: list[Path], companion: Path | None = None) -> tuple[list[SourceExample], MatchingBody]:
    examples = []
    for file in files:
        other = None if companion is None else companion.read_bytes()
        clip = read_motion(file.read_bytes(), file.name, companion=other).clip
        assert clip is not None
        examples.append(SourceExample(file.stem, file.stem, clip))
    skeleton = examples[0].clip.skeleton
    return examples, MatchingBody.from_mapping(skeleton, map_joints(skeleton))


def require_aligned(aligned: AlignedSet, examples: list[SourceExample], body: MatchingBody) -> None:
    """Check that every example faces +z at the origin, moves like the reference, and can be restored to its source."""
    reference = next(clip for clip in aligned.clips if clip.uid == aligned.reference).motion.rotations
    for clip, example in zip(aligned.clips, examples, strict=True):
        positions = clip.motion.positions(body.skeleton)
        assert forward_directions(positions, body.lefts, body.rights)[0] == pytest.approx((0.0, 1.0), abs=1e-9)
        assert positions[0, body.carrier, ::2] == pytest.approx((0.0, 0.0), abs=1e-9)
        assert np.diff(clip.time_function).min() >= 0.01
        assert np.einsum("fjc,fjc->j", clip.motion.rotations, reference).min() > 0.0

        source = resample_motion(Motion.of(example.clip), example.clip.frame_rate_hz, RATE_HZ)
        back = restore(clip, body.skeleton)
        assert back.frame_count == source.frame_count
        below = slice(body.carrier, None)
        gaps = back.positions(body.skeleton)[:, below] - source.positions(body.skeleton)[:, below]
        assert np.linalg.norm(gaps, axis=-1).mean() < 0.01


def test_six_ways_to_raise_a_hand_become_one_action(mocap: Path) -> None:
    files = sorted((mocap / "bandai-namco-2").glob("*raise-up*right-hand*normal*.bvh"))
    examples, body = examples_in(files)
    assert len(examples) == 6
    aligned = align_clips(examples, body, AlignOptions(rate_hz=RATE_HZ))
    require_aligned(aligned, examples, body)
    assert max(clip.cost for clip in aligned.clips) < 0.02**2
    right_hand = body.standard_joints["right_wrist"]
    heights = np.array([clip.motion.positions(body.skeleton)[:, right_hand, 1] for clip in aligned.clips])
    assert np.ptp(heights.argmax(axis=1)) <= 8
    assert np.ptp(heights, axis=0).max() < 0.25


def test_walks_of_one_person_are_in_step(mocap: Path) -> None:
    folder = mocap / "cmu-amc" / "07"
    examples, body = examples_in(sorted(folder.glob("*walk.amc"))[:5], folder / "07.asf")
    aligned = align_clips(examples, body, AlignOptions(rate_hz=RATE_HZ))
    require_aligned(aligned, examples, body)
    lefts, rights = body.feet
    ahead = []
    for clip in aligned.clips:
        positions = clip.motion.positions(body.skeleton)
        ahead.append(positions[:, lefts, 2] - positions[:, rights, 2])
    gaits = np.corrcoef(np.array(ahead))
    assert gaits.min() > 0.7

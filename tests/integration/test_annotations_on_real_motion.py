"""Annotation of real takes: walks divided into steps, and raised hands."""

from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from marey_motion.clip import Clip
from marey_motion.editing.annotations.layers import Layer
from marey_motion.editing.annotations.speed_proposals import propose_reaches
from marey_motion.editing.annotations.step_proposals import propose_steps
from marey_motion.formats import read_motion
from marey_motion.matching.body import MatchingBody
from marey_motion.rigs import map_joints
from marey_schemas.formats.companions import pair_companions
from marey_schemas.options.annotations import WristContactProposal

SUBJECTS = ("02", "05", "07", "09", "16")


def annotate(folder: Path, pattern: str, propose: Callable[..., Any]) -> dict[str, tuple[float, Layer]]:
    """Annotate every take with `propose`; return, by file name, the frame rate in Hz and the annotation layer."""
    names = sorted(str(path.relative_to(folder)) for path in folder.glob(pattern))
    companions = {pairing.file: pairing.companion for pairing in pair_companions(names)}
    layers = {}
    for name in names:
        companion = companions.get(name)
        data = None if companion is None else (folder / companion).read_bytes()
        clip = read_motion((folder / name).read_bytes(), name, companion=data).clip
        if clip is not None:
            body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
            layers[name] = clip.frame_rate_hz, propose(clip, body)
    return layers


@pytest.fixture(scope="module")
def walks(mocap: Path) -> dict[str, tuple[float, Layer]]:
    found: dict[str, tuple[float, Layer]] = {}
    for subject in SUBJECTS:
        found |= annotate(mocap, f"cmu-amc/{subject}/*.a[sm][fc]", propose_steps)
    return found


def test_five_subjects_walk_sixty_steps_with_each_foot(walks: dict[str, tuple[float, Layer]]) -> None:
    steps = Counter(segment.label for _, layer in walks.values() for segment in layer.segments)
    assert steps["step_left"] >= 60 <= steps["step_right"]


def test_steps_follow_each_other_left_and_right_and_last_as_steps_do(walks: dict[str, tuple[float, Layer]]) -> None:
    for rate_hz, layer in walks.values():
        steps = [one for one in layer.segments if one.label.startswith("step_")]
        for before, after in pairwise(steps):
            assert before.label != after.label or before.end < after.start
        assert all(0.25 <= (one.end - one.start) / rate_hz <= 1.0 for one in steps)
        for one in steps:
            assert sum(one.start <= keyframe.frame < one.end for keyframe in layer.keyframes) == 1


def test_jumps_runs_and_punches_hold_no_steps_of_a_walk(walks: dict[str, tuple[float, Layer]]) -> None:
    for name in ("02_05", "16_01", "16_03", "16_35", "16_45", "09_01"):
        (layer,) = [layer for place, (_, layer) in walks.items() if name in place]
        assert not [one for one in layer.segments if one.label.startswith("step_")]


def test_each_raised_hand_is_one_reach_of_the_right_hand_with_a_contact(mocap: Path) -> None:
    def propose(clip: Clip, body: MatchingBody) -> Layer:
        return propose_reaches(clip, body, WristContactProposal(release=True))

    found = annotate(mocap, "bandai-namco-2/*raise-up-right-hand*.bvh", propose)
    assert len(found) == 24
    for _, layer in found.values():
        (reach,) = layer.segments
        assert reach.label == "reach_right"
        contact, release = layer.keyframes
        assert (contact.label, release.label) == ("contact", "release")
        assert reach.start + 5 < contact.frame < release.frame - 5 < reach.end - 10
        assert reach.end - reach.start > 0.7 * layer.frame_count

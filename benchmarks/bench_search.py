"""Trees of samples, searches and refinement, compared with k-means of scikit-learn and with published times."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import KMeans
from threadpoolctl import threadpool_limits

from benchmarks.timing import Row, Timing, time_in_turn
from marey_motion.alignment.aligned import AlignedSet
from marey_motion.alignment.aligning import SourceExample, align_clips
from marey_motion.gait import GaitStyle, generate_gait
from marey_motion.kinematics import forward_kinematics
from marey_motion.matching.body import MatchingBody
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.search.objective import build_objective
from marey_motion.modelling.search.optimise import refine
from marey_motion.modelling.search.samples import search_closely
from marey_motion.modelling.search.steps import SeveralSteps, Step
from marey_motion.modelling.search.tree import END_EFFECTORS, SampleTree, build_tree
from marey_motion.modelling.search.tree_documents import sample_tree_to_tree
from marey_motion.modelling.training import train_primitive
from marey_motion.rigs import map_joints
from marey_schemas.encoding.codecs import MSGPACK, encode_tree
from marey_schemas.options.modelling import ModelOptions, TreeOptions
from marey_schemas.options.searching import RefineOptions
from marey_schemas.search_constraints import JointPositionConstraint

Floats = NDArray[np.float64]

EXAMPLES, TARGETS, NOISE_M = 30, 15, 0.005
FRAME = 24.0
COMPONENTS = 25
"""Number of components of the published model."""

LEAF = 50

# What the published system took, on two cores of the same kind, with 10,000 samples: building its tree and the size of
# it, and 15 wrist targets: searches with 1, 4 and 8 candidates and the error found, and refinement.
PUBLISHED_TREE_S, PUBLISHED_TREE_MB = 12.3, 21.3
PUBLISHED_SEARCH = {1: (27.7, 0.72), 4: (100.0, 0.30), 8: (180.0, 0.33)}
PUBLISHED_REFINE_MS, PUBLISHED_REFINED_CM = 237.0, 0.35

GOAL_TREE_S, GOAL_TREE_MB, GOAL_SEARCH_MS = 0.5, 2.0, 3.0
GOAL_SEARCHED_CM, GOAL_REFINED_CM = 0.3, 0.05
REPEATS = 9


class _Material(NamedTuple):
    """A model of walks, and positions of the wrist in walks that were not used to train the model."""

    primitive: MotionPrimitive
    joints: dict[str, int]
    targets: Floats


def run() -> list[Row]:
    """Run all measurements of this module on one thread."""
    return [*_trees(), *_searches(), _refinement()]


@cache
def _material() -> _Material:
    clips = []
    for seed in range(EXAMPLES + TARGETS):
        random = np.random.default_rng(seed)
        speed, turn = random.uniform(0.9, 1.5), random.uniform(-0.5, 0.5)
        clips.append(generate_gait(float(speed), float(turn), 1.0, 48.0, style=GaitStyle.varied(seed)))
    mapping = map_joints(clips[0].skeleton)
    body = MatchingBody.from_mapping(clips[0].skeleton, mapping)
    aligned = align_clips([SourceExample(f"{n:02}", f"{n:02}", clip) for n, clip in enumerate(clips)], body)
    known, unseen = aligned.clips[:EXAMPLES], aligned.clips[EXAMPLES:]
    reference = aligned.reference if aligned.reference in {one.uid for one in known} else known[0].uid
    examples = AlignedSet(aligned.skeleton, aligned.frame_rate_hz, known, reference, aligned.keyframes)
    options = ModelOptions(spatial_components=COMPONENTS, leave_one_out=False, folds=0, report_samples=0)
    primitive = train_primitive(examples, options).primitive
    joints = {name: aligned.skeleton.index_of(joint) for name, joint in mapping.joints.items()}
    poses = np.stack([one.motion.poses[round(FRAME)] for one in unseen])
    wrists = forward_kinematics(aligned.skeleton, poses)[:, joints["left_wrist"]]
    return _Material(primitive, joints, wrists + np.random.default_rng(0).normal(0.0, NOISE_M, wrists.shape))


@cache
def _tree() -> SampleTree:
    primitive, joints, _ = _material()
    tree = build_tree(primitive, 0, end_effectors=[joints[name] for name in END_EFFECTORS])
    tree.means, tree.starts  # noqa: B018    computed here, once for all searches
    return tree


def _trees() -> list[Row]:
    primitive, joints, _ = _material()
    wanted = [joints[name] for name in END_EFFECTORS]
    samples = primitive.sample(10_000, 0)[:, : primitive.spatial.count].astype(np.float32)
    coarse = TreeOptions(leaf_size=LEAF, features="latent")
    with threadpool_limits(1):
        own, theirs, whole = time_in_turn(
            lambda: build_tree(primitive, 0, coarse),
            lambda: _sklearn_tree(samples),
            lambda: build_tree(primitive, 0, end_effectors=wanted),
            repeats=3,
        )
    held = sample_tree_to_tree(_tree(), model_digest="sha256:" + "0" * 64, seed=0, options=TreeOptions())
    size_mb = len(encode_tree(held, MSGPACK, arrays="blocks")) / 1e6
    dimensions = f"10,000 x {samples.shape[1]}"
    return [
        Row("tree to leaves of 50", dimensions, _ms(own), f"sklearn {_ms(theirs)}", theirs.median_s / own.median_s),
        Row(
            "tree to single samples, hands and feet", "10,000 samples", _ms(whole), f"published {PUBLISHED_TREE_S:g} s",
            PUBLISHED_TREE_S / whole.median_s, f"≤ {GOAL_TREE_S:g} s", whole.median_s <= GOAL_TREE_S,
        ),
        Row(
            "tree as stored", "10,000 samples", f"{size_mb:.2f} MB", f"published {PUBLISHED_TREE_MB:g} MB",
            PUBLISHED_TREE_MB / size_mb, f"≤ {GOAL_TREE_MB:g} MB", size_mb <= GOAL_TREE_MB,
        ),
    ]  # fmt: skip


def _sklearn_tree(samples: NDArray[np.float32]) -> int:
    """Divide samples by k-means into four groups, and each group in the same way, down to leaves; count the leaves."""
    if len(samples) <= LEAF:
        return 1
    labels = KMeans(4, n_init=1, random_state=0).fit_predict(samples)
    groups = [samples[labels == label] for label in range(4)]
    return sum(_sklearn_tree(group) for group in groups if 0 < len(group) < len(samples))


def _wrist_at(target: Floats) -> JointPositionConstraint:
    x, y, z = target.tolist()
    return JointPositionConstraint(joint="left_wrist", at=FRAME, target_m=(x, y, z))


def _searches() -> list[Row]:
    primitive, joints, targets = _material()
    tree = _tree()
    rows = []
    for candidates, passes in ((1, 1), (4, 1), (8, 1), (4, 2), (8, 2)):
        published_ms, published_cm = PUBLISHED_SEARCH[candidates]

        def search(candidates: int = candidates, passes: int = passes) -> list[float]:
            objectives = [build_objective(primitive, [_wrist_at(target)], joints) for target in targets]
            return [
                float(search_closely(one, tree, candidates=candidates, passes=passes).costs[0]) for one in objectives
            ]

        (timing,) = time_in_turn(search, repeats=REPEATS)
        each_ms, error_cm = timing.median_s / TARGETS * 1e3, float(np.median(search()))
        job = f"search, {candidates} candidates, {passes} passes" if passes > 1 else f"search, {candidates} candidates"
        goal = f"≤ {GOAL_SEARCH_MS:g} ms, ≤ {GOAL_SEARCHED_CM:g} cm" if passes > 1 else ""
        met = each_ms <= GOAL_SEARCH_MS and error_cm <= GOAL_SEARCHED_CM if goal else None
        rows.append(
            Row(
                job, f"{TARGETS} wrist targets", f"{each_ms:.2f} ms, {error_cm:.2f} cm",
                f"published {published_ms:g} ms, {published_cm:.2f} cm", published_ms / each_ms, goal, met,
            )
        )  # fmt: skip
    return rows


def _refinement() -> Row:
    primitive, joints, targets = _material()
    tree, options = _tree(), RefineOptions(likelihood_weight=0.01)
    objectives = [build_objective(primitive, [_wrist_at(target)], joints) for target in targets]
    starts = [search_closely(one, tree).latents[0] for one in objectives]
    problems = [SeveralSteps.of([Step(primitive, one.constraints, joints)]) for one in objectives]

    def improve() -> list[float]:
        refined = [refine(problem, start, options) for problem, start in zip(problems, starts, strict=True)]
        return [100.0 * float(one.errors(at.latents[None])[0, 0]) for one, at in zip(objectives, refined, strict=True)]

    (timing,) = time_in_turn(improve, repeats=REPEATS)
    each_ms, error_cm = timing.median_s / TARGETS * 1e3, float(np.median(improve()))
    return Row(
        "refinement", f"{TARGETS} wrist targets", f"{each_ms:.2f} ms, {error_cm:.3f} cm",
        f"published {PUBLISHED_REFINE_MS:g} ms, {PUBLISHED_REFINED_CM:.2f} cm", PUBLISHED_REFINE_MS / each_ms,
        f"≤ {GOAL_REFINED_CM:g} cm", error_cm <= GOAL_REFINED_CM,
    )  # fmt: skip


def _ms(timing: Timing) -> str:
    return f"{timing.median_s * 1e3:.1f} ({timing.best_s * 1e3:.1f}) ms"

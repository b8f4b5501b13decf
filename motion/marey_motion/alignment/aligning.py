"""Alignment of examples of one action: all get common (canonical) coordinates and a common (canonical) time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from marey_motion.alignment.aligned import UNKNOWN_RECORDING, AlignedClip, AlignedSet, Placement, Recording
from marey_motion.alignment.canonical import placed, to_canonical
from marey_motion.alignment.cost import CostPoints, cost_points, costs_between
from marey_motion.alignment.dtw import align
from marey_motion.alignment.reference import compared_motions, medoid, nearest_mean_length, pairwise_totals
from marey_motion.alignment.segments import (
    Cut,
    SectionedAlignment,
    Sections,
    align_sections,
    common_labels,
    require_labels,
    sections_of,
)
from marey_motion.alignment.signs import consistent_signs
from marey_motion.alignment.warp import inverse, warped
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.matching.body import MatchingBody
from marey_motion.mirroring import mirror_clip
from marey_motion.motion import Motion
from marey_motion.perception.maps import motion_map
from marey_motion.perception.measuring import MeasuredClip, measure_motion
from marey_motion.perception.metric import PerceptualMetric
from marey_motion.resampling import resample_motion
from marey_motion.skeleton import SAME_OFFSET_M, Skeleton, same_hierarchy
from marey_schemas.options.alignment import MEDOID, NEAREST_MEAN_LENGTH, AlignOptions

LEAST_CLIPS = 2
LEAST_FRAMES = 4
MOST_FRAMES = 4000
"""Maximum number of frames of one example: the costs of two such examples take 128 MB."""
MOST_JOINT_FRAMES = 30_000_000
"""Maximum product of joints and frames, summed over all examples; their alignment takes about 3 GB of memory."""
MIRRORED = "~mirrored"

Progress = Callable[[float, float | None, str], None]


@dataclass(frozen=True, eq=False)
class SourceExample:
    """A clip that shows the action.

    Parameters
    ----------
    uid : str    stable name of the example
    name : str    name shown to people; if several examples are equally good references, the first in the order of name
        and uid is chosen
    clip : Clip    the motion
    cuts : tuple of Cut    labelled frames of the clip, in the order of time (`segments.cuts_of`); all examples must
        have cuts with the same labels
    recording : Recording    take and performer; without a name of the take, the example is a take of its own
    """

    uid: str
    name: str
    clip: Clip
    cuts: tuple[Cut, ...] = ()
    recording: Recording = UNKNOWN_RECORDING


@dataclass(frozen=True, eq=False)
class _Prepared:
    """An example in canonical coordinates, resampled to the frame rate of the set."""

    example: SourceExample
    motion: Motion
    placement: Placement
    sections: Sections
    points: CostPoints | MeasuredClip

    @property
    def uid(self) -> str:
        return self.example.uid


OnRefusal = Callable[[SourceExample, MotionError], None]


def with_mirrored(examples: Sequence[SourceExample], body: MatchingBody) -> list[SourceExample]:
    """Add a mirrored copy of each example, with `~mirrored` at the end of its uid and name.

    Parameters
    ----------
    examples : sequence of SourceExample    the examples
    body : MatchingBody    body of their skeleton

    Returns
    -------
    list of SourceExample    the examples and their mirrored copies
    """
    mirrored = [
        replace(one, uid=one.uid + MIRRORED, name=one.name + MIRRORED, clip=mirror_clip(one.clip, body.partners))
        for one in examples
    ]
    return [*examples, *mirrored]


def align_clips(
    clips: Sequence[SourceExample],
    body: MatchingBody,
    options: AlignOptions | None = None,
    *,
    metric: PerceptualMetric | None = None,
    threads: int = 1,
    progress: Progress | None = None,
    on_refusal: OnRefusal | None = None,
) -> AlignedSet:
    """Align all examples of an action with a reference example, in space and in time.

    If the examples have cuts, each section between two cuts is aligned with the same section of the reference. The
    result has the same bytes for any number of threads and any order of the clips.

    Parameters
    ----------
    clips : sequence of SourceExample    clips of one skeleton
    body : MatchingBody    body of that skeleton
    options : AlignOptions, optional    options; `options.reference` may be the uid of an example
    metric : PerceptualMetric, optional    metric whose distance, without unit, is the cost of a pair of poses; if None,
        the cost is that of `frame_costs`, in square metres
    threads : int    threads to use
    progress : callable, optional    called as progress(done, total, note)
    on_refusal : callable, optional    called as on_refusal(example, error) for each example that cannot be aligned and
        is left out. The error is raised instead if `on_refusal` is None or the example is the reference.

    Returns
    -------
    AlignedSet    the aligned examples

    Raises
    ------
    MotionError    if the options do not fit the clips, or if fewer than two examples can be aligned
    """
    how = options or AlignOptions()
    if metric is not None and (how.weights or how.window > 1 or how.cost != AlignOptions().cost):
        raise MotionError(
            "a perceptual metric replaces the options cost, window and weights; leave these three options out",
            code="option-invalid",
        )
    run = _Aligning(body, how, metric, threads, progress or (lambda _done, _total, _note: None))
    run.on_refusal = on_refusal
    return run.align(sorted(clips, key=lambda one: (one.name, one.uid)))


class _Aligning:
    """One alignment of a set of clips, with its options, threads and callbacks."""

    on_refusal: OnRefusal | None = None

    def __init__(
        self,
        body: MatchingBody,
        options: AlignOptions,
        metric: PerceptualMetric | None,
        threads: int,
        progress: Progress,
    ) -> None:
        self._body = body
        self._options = options
        self._metric = metric
        self._weights = joint_weights(body, options.weights)
        self._threads = max(1, threads)
        self._tell = progress

    def align(self, clips: Sequence[SourceExample]) -> AlignedSet:
        self._require_options(clips)
        rate_hz = self._rate_of(clips)
        self._require_size(clips, rate_hz)
        self._tell(0, None, f"reading {len(clips)} clips")
        prepared = self._kept(clips, [self._attempt(self._prepare, one, rate_hz) for one in clips])
        common = self._common_labels(prepared)
        prepared = self._kept(
            [one.example for one in prepared],
            [self._attempt(self._with_labels, one, common) for one in prepared],
        )
        reference = prepared[self._reference_among(prepared)]
        with ThreadPoolExecutor(self._threads) as pool:
            tries = list(pool.map(partial(self._attempt, self._aligned, reference), prepared))
        clips_aligned = self._kept([one.example for one in prepared], tries)
        return AlignedSet(
            skeleton=self._body.skeleton,
            frame_rate_hz=rate_hz,
            clips=tuple(clips_aligned),
            reference=reference.uid,
            keyframes=reference.sections.keyframes,
        )

    # -- checks and preparation --

    def _require_options(self, clips: Sequence[SourceExample]) -> None:
        repeated = [uid for uid, count in Counter(one.uid for one in clips).items() if count > 1]
        if repeated:
            raise MotionError("two examples have this uid; each example needs a different one", where=repeated[0])
        wanted = self._options.reference
        if wanted not in (MEDOID, NEAREST_MEAN_LENGTH) and wanted not in {one.uid for one in clips}:
            raise MotionError(
                f"the reference is not one of the clips to align; choose one of them, {MEDOID} or "
                f"{NEAREST_MEAN_LENGTH}",
                code="unknown-reference",
                where=wanted,
            )

    def _require_size(self, clips: Sequence[SourceExample], rate_hz: float) -> None:
        frames = sum(one.clip.frame_count / one.clip.frame_rate_hz * rate_hz for one in clips)
        size = frames * self._body.skeleton.joint_count
        if size > MOST_JOINT_FRAMES:
            raise MotionError(
                f"{len(clips)} clips with {frames:,.0f} frames of {self._body.skeleton.joint_count} joints at "
                f"{rate_hz:g} Hz are {size / MOST_JOINT_FRAMES:.1f} times as much data as can be aligned at "
                "once; use fewer clips or a lower frame rate",
                code="too-much",
            )

    def _attempt(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function, and return its result or the `MotionError` that it raises."""
        try:
            return work(*arguments)
        except MotionError as error:
            return error

    def _kept(self, examples: Sequence[SourceExample], tries: Sequence[Any]) -> list[Any]:
        """Return the results that are not errors, and pass each error to `on_refusal`.

        Raises `MotionError` if `on_refusal` is None, if the reference failed, or if too few results remain.
        """
        for example, made in zip(examples, tries, strict=True):
            if isinstance(made, MotionError):
                if self.on_refusal is None or example.uid == self._options.reference:
                    raise MotionError(str(made), code=made.code, where=example.name) from made
                self.on_refusal(example, made)
        kept = [made for made in tries if not isinstance(made, MotionError)]
        if len(kept) < LEAST_CLIPS:
            raise MotionError(
                f"only {len(kept)} of {len(examples)} clips can be aligned; at least {LEAST_CLIPS} are needed",
                code="too-few-clips",
            )
        return kept

    def _rate_of(self, clips: Sequence[SourceExample]) -> float:
        if self._options.rate_hz is not None:
            return self._options.rate_hz
        rates = {one.uid: one.clip.frame_rate_hz for one in clips}
        if self._options.reference in rates:
            return rates[self._options.reference]
        counts = Counter(rates.values())
        if not counts:
            raise MotionError(
                f"no clips were given; choose at least {LEAST_CLIPS} clips to align", code="too-few-clips"
            )
        return min(counts, key=lambda rate: (-counts[rate], rate))

    def _prepare(self, example: SourceExample, rate_hz: float) -> _Prepared:
        clip, skeleton = example.clip, self._body.skeleton
        if not same_hierarchy(clip.skeleton, skeleton, tolerance_m=SAME_OFFSET_M):
            raise MotionError(
                "the clip has a different skeleton from the other clips; retarget it first", code="skeleton-mismatch"
            )
        for cut in example.cuts:
            if not 0 <= cut.frame < clip.frame_count:
                shown = ", ".join(cut.labels)
                raise MotionError(
                    f"the frame of the cut is outside the clip, whose frames are 0 to {clip.frame_count - 1}; correct "
                    "the annotation",
                    code="outside-clip",
                    where=f"{shown}, frame {cut.frame}",
                )
        motion = resample_motion(Motion.of(clip), clip.frame_rate_hz, rate_hz)
        frames = motion.frame_count
        if not LEAST_FRAMES <= frames <= MOST_FRAMES:
            raise MotionError(
                f"the clip has {frames} frames at {rate_hz:g} Hz; a clip to align must have {LEAST_FRAMES} to "
                f"{MOST_FRAMES} frames",
                code="too-short" if frames < LEAST_FRAMES else "too-long",
            )
        sections = sections_of(example.cuts, frames, rate_ratio=rate_hz / clip.frame_rate_hz)
        moved, placement = to_canonical(motion, self._body, keep_height=self._options.keep_height)
        points = (
            cost_points(moved.positions(skeleton), self._options, self._weights)
            if self._metric is None
            else measure_motion(moved, self._body, rate_hz)
        )
        return _Prepared(example, moved, placement, sections, points)

    def _common_labels(self, prepared: Sequence[_Prepared]) -> tuple[tuple[str, ...], ...]:
        labels = {one.uid: one.sections.labels for one in prepared}
        return labels.get(self._options.reference) or common_labels(labels)

    def _with_labels(self, one: _Prepared, common: tuple[tuple[str, ...], ...]) -> _Prepared:
        require_labels(one.sections.labels, common)
        return one

    # -- the reference --

    def _reference_among(self, prepared: Sequence[_Prepared]) -> int:
        wanted = self._options.reference
        if wanted == NEAREST_MEAN_LENGTH:
            return nearest_mean_length([one.motion.frame_count for one in prepared])
        if wanted != MEDOID:
            return [one.uid for one in prepared].index(wanted)
        places = compared_motions(len(prepared))
        compared = [prepared[place] for place in places]
        totals = pairwise_totals(
            [one.points for one in compared],
            [one.sections.bounds for one in compared],
            self._costs,
            max_run=self._options.slope_limit,
            threads=self._threads,
            progress=lambda done, total: self._tell(done, total, f"comparing {len(compared)} clips"),
        )
        return places[medoid(totals)]

    # -- the alignment --

    def _aligned(self, reference: _Prepared, one: _Prepared) -> AlignedClip:
        found = self._found(reference, one)
        motion = warped(one.motion, found.times)
        return AlignedClip(
            uid=one.uid,
            name=one.example.name,
            motion=_with_signs_of(motion, reference.motion),
            time_function=found.times,
            placement=one.placement,
            cost=found.mean_cost,
            source_frames=one.motion.frame_count,
            recording=one.example.recording,
        )

    def _found(self, reference: _Prepared, one: _Prepared) -> SectionedAlignment:
        return align_sections(
            self._costs(reference.points, one.points),
            reference.sections.bounds,
            one.sections.bounds,
            partial(align, max_run=self._options.slope_limit),
        )

    def _costs(self, a: CostPoints | MeasuredClip, b: CostPoints | MeasuredClip) -> Floats:
        if isinstance(a, MeasuredClip) and isinstance(b, MeasuredClip) and self._metric is not None:
            return motion_map(a, b, self._metric)
        assert isinstance(a, CostPoints)
        assert isinstance(b, CostPoints)
        return costs_between(a, b, self._options)


def joint_weights(body: MatchingBody, given: Mapping[str, float]) -> Floats:
    """Compute the weights of the joints in the cost.

    Parameters
    ----------
    body : MatchingBody    J joints
    given : mapping of str to float    weights by joint name; a name of the skeleton or a standard name

    Returns
    -------
    (J,) float64    weight of each joint. Joints without a given weight get 1 if they are the carrier (the joint that
        carries the body) or descend from it, otherwise 0

    Raises
    ------
    MotionError    if a given name belongs to no joint
    """
    paths = (body.skeleton.path_to_root(joint) for joint in range(body.skeleton.joint_count))
    weights = np.array([float(body.carrier in path) for path in paths])
    for name, weight in given.items():
        if name not in body.skeleton and name in body.standard_joints:
            weights[body.standard_joints[name]] = weight
        else:
            weights[body.skeleton.index_of(name)] = weight
    return weights


def _with_signs_of(motion: Motion, reference: Motion) -> Motion:
    """Negate all quaternions of a joint if, on average, they have the opposite sign to those of the reference."""
    return motion._replace(rotations=consistent_signs(motion.rotations[None], reference.rotations)[0])


def restore(clip: AlignedClip, skeleton: Skeleton) -> Motion:
    """Compute the source motion of an aligned clip, with its original timing and place: the inverse of `align_clips`.

    The result is exact if `clip.time_function` is the identity; otherwise the poses are interpolated between canonical
    frames.

    Parameters
    ----------
    clip : AlignedClip    the aligned example
    skeleton : Skeleton    its skeleton

    Returns
    -------
    Motion    the source at the frame rate of the set, at its original place
    """
    return placed(warped(clip.motion, inverse(clip.time_function)), clip.placement, skeleton)

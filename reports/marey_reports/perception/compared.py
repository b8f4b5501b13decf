"""Compared clips with their distances, the data for drawing them, and sentences about what the metric can show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from marey_motion.perception.comparing import ClipDistances, ComparableClip
from marey_motion.perception.maps import component_map, motion_map
from marey_motion.perception.measuring import MeasuredClip
from marey_motion.perception.metric import PerceptualMetric, metric_of
from marey_motion.perception.registration import RegistrationCurve, registration_curve
from marey_reports.perception.motion_maps import NamedClip
from marey_schemas.documents.metrics import MetricDocument
from marey_schemas.options.perception import DistanceOptions

MOST_DRAWN_FRAMES = 1200
"""Greatest number of rows, and of columns, of a drawn map; of longer clips, only every n-th frame is shown."""
_PUBLISHED_MEAN = 5 / 6


@dataclass(frozen=True)
class ComparedClip:
    """Facts about a compared clip.

    Parameters
    ----------
    name : name shown to users
    recorded_frames : number of frames of the whole clip, at the rate of the metric
    compared_frames : number of frames of the part that was compared
    cyclic : whether the compared part is a loop
    period_frames, start_frame : period of the clip, and first frame of the loop that was cut out of it; None if no loop
        was cut
    """

    name: str
    recorded_frames: int
    compared_frames: int
    cyclic: bool
    period_frames: int | None = None
    start_frame: int | None = None

    @classmethod
    def of(cls, clip: ComparableClip) -> Self:
        """Return the facts about a clip that is ready to be compared."""
        loop = () if clip.period is None else (clip.period.frames, clip.period.start)
        return cls(clip.name, clip.recorded.frame_count, clip.compared.frame_count, clip.compared.cyclic, *loop)


def drawn_pairs(distances: ClipDistances) -> tuple[tuple[int, int], ...]:
    """Return the pairs whose maps are drawn: the nearest and the farthest, or the only one."""
    ranked = distances.pairs_by_distance()
    chosen = ranked[:1] if len(ranked) == 1 else ranked[[0, -1]]
    return tuple((int(i), int(j)) for i, j in chosen)


@dataclass(frozen=True, eq=False)
class ComparedSet:
    """N clips that were compared by a metric.

    Parameters
    ----------
    metric : the metric
    clips : facts about the clips
    drawn : the clips of `drawn_pairs`, by number
    distances : distances of all pairs
    options : options of the comparison
    """

    metric: MetricDocument
    clips: Sequence[ComparedClip]
    drawn: Mapping[int, ComparableClip]
    distances: ClipDistances
    options: DistanceOptions

    @cached_property
    def computed(self) -> PerceptualMetric:
        """The metric in the form that functions of `marey_motion` accept."""
        return metric_of(self.metric)

    def curve(self, pair: tuple[int, int]) -> RegistrationCurve:
        """Return the registration curve of a pair."""
        return registration_curve(self.drawn[pair[0]].compared, self.drawn[pair[1]].compared, self.computed)

    def drawable(self, pair: tuple[int, int]) -> tuple[NamedClip, NamedClip]:
        """Return the compared clips of a pair at one frame rate, with frames left out if there are too many to draw."""
        clips = [self.drawn[number] for number in pair]
        step = -(-max(clip.compared.frame_count for clip in clips) // MOST_DRAWN_FRAMES)
        one, other = (NamedClip(clip.name, _thinned(clip.compared, step)) for clip in clips)
        return one, other

    def recorded(self, number: int) -> NamedClip:
        """Return a clip as it was recorded, with frames left out if there are too many to draw."""
        clip = self.drawn[number]
        return NamedClip(clip.name, _thinned(clip.recorded, -(-clip.recorded.frame_count // MOST_DRAWN_FRAMES)))

    def arrays(self, pair: tuple[int, int]) -> dict[str, np.ndarray]:
        """Return the arrays of a pair by name: maps of components, combined map, frame rate, and registration curve."""
        one, other = self.drawable(pair)
        curve, rate = self.curve(pair), self.metric.frame_rate_hz
        maps = {
            component.measurement: component_map(one.clip, other.clip, self.computed, component)
            for component in self.computed.components
        }
        found: dict[str, np.ndarray] = {name: np.asarray(values, np.float32) for name, values in maps.items()}
        found["combined"] = np.asarray(motion_map(one.clip, other.clip, self.computed), np.float32)
        found["map_rate_hz"] = np.array(one.clip.rate_hz)
        found["curve_first_s"], found["curve_second_s"] = np.arange(len(curve.times)) / rate, curve.times / rate
        return found

    def missing_classes(self) -> tuple[str, ...]:
        """Return the joint classes that the metric gives a weight above 0, but that the skeleton of the clips lacks."""
        has = next(iter(self.drawn.values())).compared.classes
        weighted = [name for one in self.metric.components for name, weight in one.weights.items() if weight > 0]
        return tuple(dict.fromkeys(name for name in weighted if name not in has))

    def claims(self) -> Iterator[str]:
        """Yield texts of one or two sentences about what the metric can and cannot show for these clips."""
        yield from _claims_of(self.metric)
        if self.options.cycles == "whole" and not all(clip.cyclic for clip in self.clips):
            yield (
                "Whole clips were compared from their first to their last frames. If they contain different numbers of "
                "steps, moments that do not belong together are compared."
            )
        if missing := self.missing_classes():
            yield (
                f"The skeleton has no {', no '.join(missing)}. The weights of these joints are spread over the other "
                "joints; no judgements of people confirm such weights."
            )
        if self.distances.totals.max() > 1.0:
            yield "Distances above 1 have no counterpart in people's judgements; only their order has a meaning."
        yield from self.metric.notes


def _claims_of(metric: MetricDocument) -> Iterator[str]:
    if metric.origin == "uniform":
        yield (
            "All joints have equal weights, which were not fitted to judgements of people: the distances say which "
            "clips move alike, not how different they look."
        )
        return
    who = "29 people who judged walks of 21 others on one neutral figure"
    mean = f" The mean difference of two of these walks is {_PUBLISHED_MEAN:.2f}."
    if metric.origin == "fitted":
        known = metric.fit
        who = (
            "people who judged" if known is None else f"{known.participants} people who judged {known.motions} motions"
        )
        mean = ""
    yield (
        f"The weights come from {who}: a distance estimates how rarely people would call two motions the most similar "
        f"of four, from 0 (always) to 1 (never).{mean}"
    )
    if metric.origin == "fitted" and (metric.fit is None or metric.fit.noise_ceiling is None):
        yield "The standard error of the judgements is not known, so small differences of distances may be noise."
        return
    yield (
        f"The judgements themselves have a standard error of {metric.judgement_error:.2f}, so the metric cannot order "
        f"distances that differ by less than {2 * metric.judgement_error:.2f}."
    )
    if metric.origin == "published":
        yield "Only natural walks were judged. Runs, turns, dances and single poses were not judged."


def _thinned(clip: MeasuredClip, step: int) -> MeasuredClip:
    if step == 1:
        return clip
    return replace(clip.at(np.arange(0, clip.frame_count, step, dtype=np.float64)), rate_hz=clip.rate_hz / step)

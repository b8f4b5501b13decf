"""Figure of the time model: the effect of each time component, and the durations of motions."""

from __future__ import annotations

from typing import Any

import numpy as np

from marey_motion.arrays import Floats
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import COLOURS, INK, REFERENCE, Place, add_keys, add_panel, new_figure
from marey_reports.models.figures.canonical_time import CANONICAL_TIME, limit_above, mark_keyframes, percents
from marey_reports.models.figures.components import DEVIATIONS, written
from marey_reports.models.figures.subjects import ModelSubject

MOST_COMPONENTS = 3
COUNTED_SAMPLES = 1000
SWEEP = (
    (COLOURS[0], (0, (4.0, 1.2)), 1.5),
    (COLOURS[0], "-", 1.2),
    (INK, "-", 1.9),
    (COLOURS[1], "-", 1.2),
    (COLOURS[1], (0, (4.0, 1.2)), 1.5),
)
WIDTH, HEIGHT = 2.7, 1.9


def draw_time_components(subject: ModelSubject) -> Sketch | None:
    """Draw time functions (time warps) and speeds along each time component; return None if there are no components."""
    primitive = subject.primitive
    count = min(MOST_COMPONENTS, primitive.temporal.count)
    if not count:
        return None
    figure = new_figure(1.15 + count * (WIDTH + 0.35) + 1.0, 2 * HEIGHT + 1.75)
    swept = [sweep_time(subject, component) for component in range(count)]
    highest = np.max([passed.max(axis=0) for passed in swept], axis=0)
    rates = [_rates(passed, primitive.frame_rate_hz) for passed in swept]
    fastest = float(max(2.0, *(rate.max() for rate in rates)))
    shares = percents(primitive.frame_count)
    for component, (passed, rate) in enumerate(zip(swept, rates, strict=True)):
        left, first = 0.75 + component * (WIDTH + 0.35), component == 0
        above = add_panel(figure, Place(left, HEIGHT + 1.15, WIDTH, HEIGHT), title=f"time component {component + 1}",
                          y="elapsed time (s)" if first else "")  # fmt: skip
        below = add_panel(figure, Place(left, 0.7, WIDTH, HEIGHT), x=CANONICAL_TIME,
                          y="speed (2: twice as fast)" if first else "")  # fmt: skip
        for panel, values, places in ((above, passed, shares), (below, rate, 0.5 * (shares[1:] + shares[:-1]))):
            for row, (colour, style, width) in enumerate(SWEEP):
                panel.plot(places, values[row], color=colour, ls=style, lw=width, label=written(DEVIATIONS[row]))
            mark_keyframes(panel, subject.primitive.keyframes, primitive.frame_count, named=panel is above and first)
            panel.set_xlim(0.0, 100.0)
        above.set_ylim(0.0, limit_above(highest, primitive.keyframes, HEIGHT))
        below.set_ylim(0.0, 1.04 * fastest)
        if component == count - 1:
            add_keys(above, loc="upper left", bbox_to_anchor=(1.0, 1.02), reverse=True)
    spans = [f"component {number + 1} from {passed[0, -1]:.2f} to {passed[-1, -1]:.2f} s" for number, passed in
             enumerate(swept)]  # fmt: skip
    caption = (
        "Effect of each time component, from two standard deviations below the mean to two above it. Upper row: "
        "elapsed time at each canonical moment; lower row: speed there, relative to the reference. Durations: "
        f"{', '.join(spans)}."
    )
    table = {
        "component": np.repeat(np.arange(1, count + 1), len(DEVIATIONS) * len(shares)),
        "deviations": np.tile(np.repeat(DEVIATIONS, len(shares)), count),
        "canonical_frame": np.tile(np.arange(len(shares)), count * len(DEVIATIONS)),
        "time_s": np.concatenate([passed.ravel() for passed in swept]),
    }
    return Sketch(figure, {"time": table}, caption)


def sweep_time(subject: ModelSubject, component: int) -> Floats:
    """Compute the elapsed seconds (5, N) at each canonical frame of five motions.

    The motions are at -2, -1, 0, 1 and 2 standard deviations of the time component.
    """
    primitive = subject.primitive
    latents = np.zeros((len(DEVIATIONS), primitive.dimensions))
    deviation = primitive.temporal_weight * np.sqrt(primitive.temporal.variances[component])
    latents[:, primitive.spatial.count + component] = np.array(DEVIATIONS) * deviation
    return primitive.time_functions(latents) / primitive.frame_rate_hz


def _rates(passed_s: Floats, frame_rate_hz: float) -> Floats:
    """Compute the speeds (5, N - 1) of the motions relative to the reference: 2 is twice as fast."""
    return np.asarray(1.0 / (np.diff(passed_s, axis=1) * frame_rate_hz), dtype=np.float64)


def draw_durations(subject: ModelSubject) -> Sketch:
    """Draw the durations of examples and samples."""
    primitive = subject.primitive
    examples = subject.examples.time_functions[:, -1] / primitive.frame_rate_hz
    samples = primitive.durations_s(primitive.sample(COUNTED_SAMPLES, subject.seed))
    everything = np.concatenate((examples, samples))
    low, high = float(everything.min()), float(everything.max())
    margin = max(0.02 * (high - low), 0.5 / primitive.frame_rate_hz)
    edges = np.linspace(low - margin, high + margin, 31)
    figure = new_figure(8.2, 3.0)
    panel = add_panel(figure, Place(0.75, 0.65, 5.4, 1.95), x="duration (s)", y="share of motions (%)")
    drawn: tuple[tuple[Floats, str, str, dict[str, Any]], ...] = (
        (examples, REFERENCE, f"{len(examples)} examples", {"histtype": "stepfilled", "alpha": 0.55}),
        (samples, COLOURS[0], f"{len(samples):,} samples", {"histtype": "step", "lw": 1.6}),
    )
    for values, colour, label, look in drawn:
        weights = np.full(len(values), 100.0 / len(values))
        panel.hist(values, edges.tolist(), weights=weights, color=colour, label=label, **look)
    panel.set_xlim(edges[0], edges[-1])
    add_keys(panel, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    shares = [np.histogram(values, edges)[0] / len(values) for values in (examples, samples)]
    table = {"from_s": edges[:-1], "to_s": edges[1:], "examples_share": shares[0], "samples_share": shares[1]}
    caption = (
        f"Examples last {examples.min():.2f} to {examples.max():.2f} s, and 90 % of the samples "
        f"{np.quantile(samples, 0.05):.2f} to {np.quantile(samples, 0.95):.2f} s."
    )
    return Sketch(figure, {"durations": table}, caption)

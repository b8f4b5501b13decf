"""Kind `distances`: measures how different clips look to people, by a perceptual metric."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from marey_motion import documents
from marey_motion.errors import MotionError
from marey_motion.matching.body import MatchingBody
from marey_motion.perception.comparing import ClipDistances, ComparableClip, compare_clips, prepare_comparison
from marey_motion.perception.metric import metric_of
from marey_reports.perception.compared import ComparedSet
from marey_reports.perception.page import draw_distance_figures, render_distances
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.metrics import MetricDocument, MetricIdentity
from marey_schemas.options.perception import DistanceOptions
from marey_schemas.queue.job_params import MOST_COMPARED_CLIPS, DistancesParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.chosen_metric import read_metric_or_default
from marey_worker.job_io.evaluated_set import store_document, store_file
from marey_worker.job_io.matching_clips import ClipSet, common_rig, is_loop, read_motions, refusing_motion_errors
from marey_worker.job_io.refusals import Refusals
from marey_worker.job_io.skeleton_cache import read_rigged
from marey_worker.job_io.stored_reports import inputs_of, stored_figure

Prepared = tuple[PinnedInput, ComparableClip]


def run(context: Context, params: DistancesParams) -> dict[str, Any]:
    """Compare clips; the result names the nearest and the farthest pair, and refers to the document and the report.

    A clip that cannot be compared is listed as a refusal in the result. Raises `JobRefused` if fewer than two clips can
    be compared.
    """
    _require_count(len(context.inputs["clips"]))
    document = read_metric_or_default(context, params.metric)
    refusals = Refusals(context)
    with refusing_motion_errors():
        prepared = list(_prepared(context, params, document, refusals))
        if len(prepared) < 2:
            raise JobRefused(
                "too-few-clips",
                f"only {len(prepared)} of {len(context.inputs['clips'])} clips can be compared, and at least two are "
                f"needed{refusals.first}",
            )
        clips = [clip for _, clip in prepared]
        compared = [clip.compared for clip in clips]
        distances = compare_clips(
            compared, metric_of(document), threads=context.threads, progress=context.progress
        )  # fmt: skip
    subject = ComparedSet(document, clips, distances, DistanceOptions.of(params))
    result = _result(context, params, subject, prepared, refusals)
    if params.report:
        context.progress(0, None, "writing the report")
        title = params.title or " and ".join(clip.name for clip in clips[:2]) + (" …" if len(clips) > 2 else "")
        figures = draw_distance_figures(subject)
        page = render_distances(subject, figures, title=title, inputs=inputs_of(context))
        result["report"] = store_file(context, page.encode())
        stored = [stored_figure(context, figure) for figure in figures.values()]
        result["figures"] = [figure.model_dump(mode="json", by_alias=True) for figure in stored]
    return result


def _require_count(count: int) -> None:
    if count > MOST_COMPARED_CLIPS:
        raise JobRefused(
            "too-many-clips",
            f"{count:,} clips are given, and at most {MOST_COMPARED_CLIPS} can be compared with each other; compare "
            "fewer clips",
        )


def _prepared(
    context: Context, params: DistancesParams, document: MetricDocument, refusals: Refusals
) -> Iterator[Prepared]:
    """Yield the clips that can be compared; refuse the others. Raises `JobRefused` for clips of several skeletons."""
    pins = context.inputs["clips"]
    (rig,) = context.inputs.get("rig", ()) or (None,)
    motions: Sequence[tuple[str, MotionDocument]] = list(read_motions(context, pins))
    rigged = read_rigged(context, common_rig(context, ClipSet(pins, rig), motions))
    body, metric = MatchingBody.from_mapping(rigged.skeleton, rigged.mapping), metric_of(document)
    for done, ((pin, info), (_, motion)) in enumerate(
        zip(context.documents(pins, "info", required=False), motions, strict=True)
    ):
        context.progress(done, len(pins), f"measuring {pin.name}")
        try:
            clip = documents.clip_from_document(motion, rigged.skeleton)
            loop = is_loop(pin, info, params.loops)
            yield (
                pin,
                prepare_comparison(
                    clip, body, metric, document.frame_rate_hz, name=pin.path, cycles=params.cycles, loop=loop
                ),
            )
        except MotionError as error:
            refusals.add(pin, error)


def _result(
    context: Context, params: DistancesParams, subject: ComparedSet, prepared: Sequence[Prepared], refusals: Refusals
) -> dict[str, Any]:
    ranked = subject.distances.pairs_by_distance()
    tree = {
        "metric": subject.metric.stored(),
        "options": DistanceOptions.of(params).model_dump(mode="json"),
        "clips": [_clip_tree(pin, clip, subject.metric.frame_rate_hz) for pin, clip in prepared],
        "distances": subject.distances.totals,
        "components": {
            one.measurement: table
            for one, table in zip(subject.metric.components, subject.distances.by_component, strict=True)
        },
        "refused": refusals.entries,
        "says": list(subject.claims()),
    }
    return {
        "clips": len(prepared),
        "pairs": len(ranked),
        "metric": MetricIdentity.of(subject.metric).model_dump(mode="json"),
        "nearest": _pair_tree(subject.distances, prepared, ranked[0]),
        "farthest": _pair_tree(subject.distances, prepared, ranked[-1]),
        "refused": refusals.entries,
        "document": store_document(context, tree),
        "maps": store_file(context, _maps(subject)),
    }


def _clip_tree(pin: PinnedInput, clip: ComparableClip, rate_hz: float) -> dict[str, Any]:
    period = clip.period
    return {
        "item": pin.item,
        "revision": pin.revision,
        "name": pin.path,
        "seconds": clip.compared.frame_count / rate_hz,
        "cyclic": clip.compared.cyclic,
        "period_s": None if period is None else period.frames / rate_hz,
        "start_s": None if period is None else period.start / rate_hz,
    }


def _pair_tree(distances: ClipDistances, prepared: Sequence[Prepared], pair: np.ndarray) -> dict[str, Any]:
    i, j = map(int, pair)
    return {"clips": [prepared[i][1].name, prepared[j][1].name], "distance": float(distances.totals[i, j])}


def _maps(subject: ComparedSet) -> bytes:
    """Return motion maps and registration curves of the drawn pairs as a NumPy archive (.npz)."""
    arrays: dict[str, np.ndarray] = {}
    for number, pair in enumerate(subject.drawn_pairs()):
        arrays |= {f"pair{number}_{name}": values for name, values in subject.arrays(pair).items()}
    buffer = io.BytesIO()
    save: Any = np.savez_compressed  # which has options besides the names of arrays
    save(buffer, **arrays)
    return buffer.getvalue()

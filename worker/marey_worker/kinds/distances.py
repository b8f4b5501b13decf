"""Kind `distances`: measures how different clips look to people, by a perceptual metric.

The clips are divided into blocks. Each task compares the clips of two blocks, so it holds few clips in memory, and
measures each of them once for many pairs. Only the first task in a process reads all clips, to find the skeleton that
they have in common.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from marey_motion import documents
from marey_motion.errors import MotionError
from marey_motion.matching.body import MatchingBody
from marey_motion.perception.comparing import ClipDistances, ComparableClip, compare_pairs, prepare_comparison
from marey_motion.perception.metric import metric_of
from marey_reports.perception.compared import ComparedClip, ComparedSet, drawn_pairs
from marey_reports.perception.page import draw_distance_figures, render_distances
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.metrics import MetricDocument, MetricIdentity
from marey_schemas.documents.references import RevisionRef
from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree
from marey_schemas.lru import LruCache
from marey_schemas.options.perception import DistanceOptions
from marey_schemas.queue.job_params import MOST_COMPARED_CLIPS, DistancesParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.chosen_metric import read_metric_or_default
from marey_worker.job_io.evaluated_set import store_document, store_file
from marey_worker.job_io.matching_clips import (
    ClipSet,
    common_rig,
    is_loop,
    read_motions,
    refusing_motion_errors,
    skeleton_of,
)
from marey_worker.job_io.refusals import Refusals
from marey_worker.job_io.skeleton_cache import Rig, read_mapped
from marey_worker.job_io.stored_reports import inputs_of, stored_figure

Prepared = dict[int, ComparableClip]
"""Clips that can be compared, by their position in the input `clips`."""

_RIGS: LruCache[bytes, Rig] = LruCache(max_entries=16)
"""Skeletons of the clips of jobs, by the inputs of the job, which all its tasks have."""


def run(context: Context, params: DistancesParams) -> dict[str, Any]:
    """Compare the clips of two blocks with each other; the result refers to a file with their distances.

    All tasks together compare all pairs of clips, whatever their number. A clip that cannot be compared is refused.
    """
    pins = context.inputs["clips"]
    _require_count(len(pins))
    document = read_metric_or_default(context, params.metric)
    first, second = _blocks(context.task.position, context.task.size, len(pins))
    wanted = sorted({*first, *second})
    refusals = Refusals(context)
    with refusing_motion_errors():
        rig, motions = _read(context, set(wanted))
        prepared, refused = _prepare(context, params, document, rig, motions, refusals)
        pairs = [(i, j) for i in first for j in second if i < j and i in prepared and j in prepared]
        table = np.array(pairs, np.int64).reshape(-1, 2)
        clips = {number: clip.compared for number, clip in prepared.items()}
        found = compare_pairs(clips, table, metric_of(document), threads=context.threads, progress=context.progress)
    tree = {
        "pairs": table,
        "distances": found,
        "clips": {str(number): asdict(ComparedClip.of(clip)) for number, clip in prepared.items()},
        "refused": {str(number): entry for number, entry in refused.items()},
        "rig": [ref.model_dump(mode="json") for ref in rig],
    }
    return {"pairs": len(pairs), "compared": store_file(context, encode_tree(tree, MSGPACK, arrays="blocks"))}


def gather(context: Context, params: DistancesParams, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Combine the distances of all tasks, and store the document, the report and its figures.

    The result names the nearest and the farthest pair of clips, and lists refused clips. Raises `JobRefused` if fewer
    than two clips can be compared.
    """
    document, pins = read_metric_or_default(context, params.metric), context.inputs["clips"]
    found = [decode_tree(context.blob(result["compared"]["blob"]), MSGPACK) for result in results]
    refused = [entry for _, entry in sorted(_by_number(found, "refused").items())]
    facts = dict(sorted(_by_number(found, "clips").items()))
    if len(facts) < 2:
        first = f"; {refused[0]['name']}: {refused[0]['detail']}" if refused else ""
        raise JobRefused(
            "too-few-clips",
            f"only {len(facts)} of {len(pins)} clips can be compared, and at least two are needed{first}",
        )
    places = np.array(list(facts))
    pairs = np.searchsorted(places, np.concatenate([one["pairs"] for one in found]))
    distances = ClipDistances.of(len(facts), pairs, np.concatenate([one["distances"] for one in found]))
    drawn = sorted({number for pair in drawn_pairs(distances) for number in pair})
    with refusing_motion_errors():
        rig = Rig(*map(RevisionRef.model_validate, found[0]["rig"]))
        shown = [pins[places[number]] for number in drawn]
        motions = zip(drawn, shown, read_motions(context, shown), strict=True)
        moving = {number: (pin, motion) for number, pin, (_, motion) in motions}
        prepared, _ = _prepare(context, params, document, rig, moving, Refusals(context))
    clips = [ComparedClip(**one) for one in facts.values()]
    subject = ComparedSet(document, clips, prepared, distances, DistanceOptions.of(params))
    result = _result(context, params, subject, [pins[number] for number in places], refused)
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


def _blocks(position: int, tasks: int, clips: int) -> tuple[range, range]:
    """Return the positions of the clips in the two blocks that a task compares; both blocks may be the same."""
    blocks = round(((8 * tasks + 1) ** 0.5 - 1) / 2)  # the number of tasks is that of all pairs of blocks
    pair = list(combinations_with_replacement(range(blocks), 2))[position]
    first, second = (range(clips * block // blocks, clips * (block + 1) // blocks) for block in pair)
    return first, second


def _by_number(found: Sequence[Mapping[str, Any]], name: str) -> dict[int, Any]:
    """Join the members `name` of the files of all tasks; the keys are positions of clips."""
    return {int(number): entry for one in found for number, entry in one[name].items()}


Moving = dict[int, tuple[PinnedInput, MotionDocument]]
"""Clips with their motions, by number."""


def _read(context: Context, wanted: Collection[int]) -> tuple[Rig, Moving]:
    """Return the skeleton of all clips, and the motions of the `wanted` clips by position.

    Raises `JobRefused` if the clips have several skeletons.
    """
    pins = context.inputs["clips"]
    (edited,) = context.inputs.get("rig", ()) or (None,)
    clips = ClipSet(pins, edited)
    key = canonical_json(clips.as_tree())
    rig = _RIGS.get(key)
    used, motions = [], Moving()
    numbers = range(len(pins)) if rig is None else sorted(wanted)
    read = read_motions(context, [pins[number] for number in numbers])
    for number, (_, motion) in zip(numbers, read, strict=True):
        used.append(skeleton_of(motion))
        if number in wanted:
            motions[number] = pins[number], motion
    if rig is None:
        rig = common_rig(context, clips, used)
        _RIGS.put(key, rig)
    return rig, motions


def _prepare(
    context: Context,
    params: DistancesParams,
    document: MetricDocument,
    rig: Rig,
    motions: Moving,
    refusals: Refusals,
) -> tuple[Prepared, dict[int, dict[str, str]]]:
    """Measure the clips to compare; if `params.cycles` is "cut", cut one cycle out of each clip that is no loop.

    Return the measured clips, and the refusals of clips that cannot be compared, both by the position of the clip.
    """
    mapped = read_mapped(context, rig)
    body, metric = MatchingBody.from_mapping(mapped.skeleton, mapped.mapping), metric_of(document)
    prepared, refused = Prepared(), dict[int, dict[str, str]]()
    infos = context.documents([pin for pin, _ in motions.values()], "info", required=False)
    for done, ((number, (pin, motion)), (_, info)) in enumerate(zip(motions.items(), infos, strict=True)):
        context.progress(done, len(motions), f"measuring {pin.name}")
        try:
            clip = documents.clip_from_document(motion, mapped.skeleton)
            loop = is_loop(pin, info, params.loops)
            prepared[number] = prepare_comparison(
                clip, body, metric, document.frame_rate_hz, name=pin.path, cycles=params.cycles, loop=loop
            )
        except MotionError as error:
            refusals.add(pin, error)
            refused[number] = refusals.entries[-1]
    return prepared, refused


def _result(
    context: Context,
    params: DistancesParams,
    subject: ComparedSet,
    pins: Sequence[PinnedInput],
    refused: Sequence[Mapping[str, str]],
) -> dict[str, Any]:
    ranked = subject.distances.pairs_by_distance()
    rate_hz = subject.metric.frame_rate_hz
    tree = {
        "metric": subject.metric.stored(),
        "options": DistanceOptions.of(params).model_dump(mode="json"),
        "clips": [_clip_tree(pin, clip, rate_hz) for pin, clip in zip(pins, subject.clips, strict=True)],
        "distances": subject.distances.totals,
        "components": {
            one.measurement: table
            for one, table in zip(subject.metric.components, subject.distances.by_component, strict=True)
        },
        "refused": refused,
        "says": list(subject.claims()),
    }
    return {
        "clips": len(pins),
        "pairs": len(ranked),
        "metric": MetricIdentity.of(subject.metric).model_dump(mode="json"),
        "nearest": _pair_tree(subject, ranked[0]),
        "farthest": _pair_tree(subject, ranked[-1]),
        "refused": refused,
        "document": store_document(context, tree),
        "maps": store_file(context, _maps(subject)),
    }


def _clip_tree(pin: PinnedInput, clip: ComparedClip, rate_hz: float) -> dict[str, Any]:
    return {
        "item": pin.item,
        "revision": pin.revision,
        "name": pin.path,
        "seconds": clip.compared_frames / rate_hz,
        "cyclic": clip.cyclic,
        "period_s": None if clip.period_frames is None else clip.period_frames / rate_hz,
        "start_s": None if clip.start_frame is None else clip.start_frame / rate_hz,
    }


def _pair_tree(subject: ComparedSet, pair: np.ndarray) -> dict[str, Any]:
    i, j = map(int, pair)
    names = [subject.clips[number].name for number in (i, j)]
    return {"clips": names, "distance": float(subject.distances.totals[i, j])}


def _maps(subject: ComparedSet) -> bytes:
    """Return motion maps and registration curves of the pairs that figures show, as a NumPy archive (.npz)."""
    arrays: dict[str, np.ndarray] = {}
    for number, pair in enumerate(drawn_pairs(subject.distances)):
        arrays |= {f"pair{number}_{name}": values for name, values in subject.arrays(pair).items()}
    buffer = io.BytesIO()
    save: Any = np.savez_compressed  # which has options besides the names of arrays
    save(buffer, **arrays)
    return buffer.getvalue()

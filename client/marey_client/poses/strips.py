"""Pictures of poses in rows: of clips and their revisions, samples of models, and trials of evaluations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from marey_client.asynchronous.interruption import CallPool
from marey_client.errors import BadArgument
from marey_client.extras import import_optional
from marey_client.handles.clips import ClipHandle
from marey_client.handles.evaluations import EvaluationHandle, trial_rows, worst_rows_first
from marey_client.handles.models import ModelHandle
from marey_client.poses.kinematics import PosedSkeleton, read_rig
from marey_client.poses.pictures import FIGURES_EXTRA, MOST_MOMENTS, READS_AT_ONCE
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.references import RevisionRef
from marey_schemas.kinds import Kind
from marey_schemas.wording import counted, part_of

MOST_ROWS = 24


@dataclass(frozen=True)
class ClipOfStrip:
    """A revision of a clip and a range of its frames, for a picture."""

    clip: ClipHandle
    revision: int | None = None
    frames: slice | None = None

    @property
    def number(self) -> int:
        """The number of the revision."""
        return self.revision or self.clip.item.revision

    def chosen(self, moments: int) -> list[int]:
        """Return the numbers of `moments` frames, evenly spaced over the range."""
        return _spread(range(*(self.frames or slice(None)).indices(self.frame_count)), moments, self.clip.path)

    def poses(self, frames: Sequence[int]) -> list[Any]:
        """Read single frames, each as a clip of `marey_motion`."""

        def read(frame: int) -> MotionDocument:
            return self.clip.motion(frames=slice(frame, frame + 1), revision=self.number)

        with CallPool(READS_AT_ONCE, thread_name_prefix="marey-poses") as pool:
            found = list(pool.map(read, frames))
        reference = found[0].skeleton
        assert isinstance(reference, RevisionRef)
        rig = read_rig(self.clip, reference)
        return [_posed(one, rig) for one in found]

    def at_times_of(self, other: ClipOfStrip, frames: Sequence[int]) -> list[int]:
        """Return the frames of this clip at the times of `frames` of another clip; times after the end are left out."""
        ratio = self.frame_rate_hz / other.frame_rate_hz
        found = [frame for frame in (round(one * ratio) for one in frames) if frame < self.frame_count]
        if not found:
            raise BadArgument(
                f"frames: {self.clip.path!r} ends before the time of the first frame; choose earlier frames"
            )
        return found

    def whole(self) -> Any:
        """Read the range of frames as a clip of `marey_motion`."""
        motion = self.clip.motion(frames=self.frames, revision=self.number)
        reference = motion.skeleton
        assert isinstance(reference, RevisionRef)
        return _posed(motion, read_rig(self.clip, reference))

    @property
    def frame_count(self) -> int:
        """The number of frames of the revision."""
        return self._length[0]

    @property
    def frame_rate_hz(self) -> float:
        """The frames per second of the revision, which can differ from those of the newest revision."""
        return self._length[1]

    @cached_property
    def _length(self) -> tuple[int, float]:
        if self.number == self.clip.item.revision:
            return self.clip.frames, self.clip.frame_rate_hz
        motion = self.clip.motion(revision=self.number)  # the summaries of earlier revisions are not stored
        return len(motion.poses), motion.frame_rate_hz


def draw_clips(first: ClipOfStrip, second: ClipOfStrip | None, moments: int, file_type: str) -> bytes:
    """Draw a clip, and another clip or revision below it, at the same times, as PNG or SVG.

    If both are revisions of the same clip, the lower row also shows the poses of the first revision, in grey behind
    those of the second. Clips with different joints are drawn side by side, as PNG only. Raises `BadArgument` if the
    second clip ends before the range begins.
    """
    frames = first.chosen(moments)
    poses = first.poses(frames)
    strips = import_optional("marey_reports.drawing.strips", FIGURES_EXTRA)
    rows = [strips.PoseRow(first.clip.name, f"revision {first.number}", poses)]
    same_clip = second is not None and second.clip.id == first.clip.id
    if second is not None:
        at_times = second.at_times_of(first, frames)
        others = second.poses(at_times)
        if others[0].skeleton.joint_names != poses[0].skeleton.joint_names:
            return _side_by_side(first, second, moments, file_type)
        frames, poses = frames[: len(others)], poses[: len(others)]
        rows = [
            strips.PoseRow(first.clip.name, f"revision {first.number}", poses),
            strips.PoseRow(second.clip.name, f"revision {second.number}", others, ghost=poses if same_clip else ()),
        ]
    labels = [f"{frame / first.frame_rate_hz:.2f} s" for frame in frames]
    ghost = f"revision {first.number}" if same_clip else ""
    figure = strips.draw_pose_rows(rows, [f"frame {frame}" for frame in frames], labels, ghost=ghost)
    return _written(figure, file_type, first.clip.path)


def _side_by_side(first: ClipOfStrip, second: ClipOfStrip, moments: int, file_type: str) -> bytes:
    sheets = import_optional("marey_reports.drawing.contact_sheet", FIGURES_EXTRA)
    if file_type != "png" or moments > sheets.MAX_MOMENTS:
        raise BadArgument(
            f"{first.clip.path!r} and {second.clip.path!r} have different joints; draw them to a .png file, at "
            f"most {sheets.MAX_MOMENTS} moments"
        )
    pair = sheets.TakePair("", second.whole(), first.whole())
    data: bytes = sheets.contact_sheet(
        [pair], heading=first.clip.name, moments=moments, sides=(second.clip.path, first.clip.path)
    )
    return data


def draw_samples(model: ModelHandle, revision: int | None, n: int, seed: int, moments: int, file_type: str) -> bytes:
    """Draw samples of a model, one per row, at equally spaced fractions of their durations, as PNG or SVG."""
    _require_rows(n)
    drawn = model.sample(n, seed, revision=revision)
    strips = import_optional("marey_reports.drawing.strips", FIGURES_EXTRA)
    rows = []
    for number, motion in enumerate(drawn.motions, 1):
        reference = motion.skeleton
        assert isinstance(reference, RevisionRef)
        rig = read_rig(model, reference)
        frames = _spread(range(len(motion.poses)), moments, model.path)
        seconds = len(motion.poses) / motion.frame_rate_hz
        poses = [_posed(_frame_of(motion, frame), rig) for frame in frames]
        rows.append(strips.PoseRow(f"sample {number}", f"seed {seed}, {seconds:.2f} s", poses))
    count = min(len(row.poses) for row in rows)
    shares = [f"{100 * place / max(1, count - 1):.0f} %" for place in range(count)]
    rows = [strips.PoseRow(row.label, row.note, row.poses[:count]) for row in rows]
    return _written(strips.draw_pose_rows(rows, ["after"] * count, shares), file_type, model.path)


def draw_worst_trials(
    evaluation: EvaluationHandle, revision: int | None, count: int, moments: int, file_type: str
) -> bytes:
    """Draw the worst trials of an evaluation, the worst first, as PNG or SVG.

    A cell shows the recorded frame that the character displayed at a moment, turned into the heading of the character;
    the smoothing after switches between clips is left out. Raises `BadArgument` if the evaluation does not rank trials.
    """
    _require_rows(count)
    document = evaluation.document(revision=revision)
    ranked = ranked_trials(evaluation, document)
    strips = import_optional("marey_reports.drawing.strips", FIGURES_EXTRA)
    records = evaluation.records(revision=revision)
    demands = demands_of_trials(document)
    shown = DisplayedFrames(evaluation, document)
    rows, times = [], []
    for one in ranked[:count]:
        name = one["trial"]
        record = records[name]
        ticks = _spread(range(len(record["rows"])), moments, name)
        times = [tick / shown.rate_hz for tick in ticks]
        poses = [shown.pose(int(record["rows"][tick])) for tick in ticks]
        limits = f"{counted(len(one['beyond_limits']), 'measure')} beyond limits"
        headings = np.asarray(record["headings"][ticks], dtype=np.float64)
        rows.append(strips.PoseRow(demands[name], limits, poses, headings_rad=headings))
    about = f"{part_of(len(rows), len(ranked), 'trial')}, the worst first"
    labels = [f"{time_s:.1f} s" for time_s in times]
    figure = strips.draw_pose_rows(rows, ["after"] * len(times), labels, about=about)
    return _written(figure, file_type, evaluation.path)


def ranked_trials(evaluation: EvaluationHandle, document: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of an evaluation's trials, the worst first. Raises `BadArgument` if they are not ranked."""
    ranked = worst_rows_first(trial_rows(document))
    if not any("worst_rank" in one for one in ranked):
        raise BadArgument(f"{evaluation.path!r} does not say which trials are the worst; evaluate the clips again")
    return ranked


def demands_of_trials(document: dict[str, Any]) -> dict[str, str]:
    """Return what each trial of an evaluation demands, as a phrase for people, by the name of the trial."""
    documents = import_optional("marey_motion.evaluation.result_documents", FIGURES_EXTRA)
    demand = import_optional("marey_motion.evaluation.scenario", FIGURES_EXTRA).demand
    trials = [documents.trial_from_document(one["trial"]) for one in document["trials"]]
    return {trial.name: demand(trial) for trial in trials}


@dataclass(frozen=True)
class RecordedFrame:
    """Frame of a recorded clip that a character displayed. `mirrored`: the character displayed its mirrored copy."""

    clip: ClipHandle
    revision: int
    frame: int
    mirrored: bool


class DisplayedFrames:
    """Lookup of the recorded frame from which a row of an evaluation's motion matching database was computed."""

    def __init__(self, evaluation: EvaluationHandle, document: dict[str, Any]) -> None:
        self.rate_hz = float(document["options"]["database"]["rate_hz"])
        self._evaluation = evaluation
        self._clips = document["clips"]
        self._starts = [one["start"] for one in self._clips]
        self._recordings: dict[tuple[str, int], ClipOfStrip] = {}

    def pose(self, row: int) -> Any:
        """Return the recorded pose of a row of the database as a clip of one frame, mirrored if the row is mirrored."""
        found = self.place(row)
        (pose,) = ClipOfStrip(found.clip, found.revision).poses([found.frame])
        return mirrored(pose) if found.mirrored else pose

    def place(self, row: int) -> RecordedFrame:
        """Return the frame of the recorded clip that corresponds to a row of the database."""
        found = self._clips[int(np.searchsorted(self._starts, row, side="right")) - 1]
        item, _, revision = found["uid"].partition("~")[0].partition("@")  # of a mirrored copy, more follows
        recorded = self._recording(item, int(revision))
        time_s = found["first_s"] + (row - found["start"]) / self.rate_hz
        frame = min(round(time_s * recorded.frame_rate_hz), recorded.frame_count - 1)
        return RecordedFrame(recorded.clip, recorded.number, frame, found["mirrored_from"] is not None)

    def _recording(self, item: str, revision: int) -> ClipOfStrip:
        if (item, revision) not in self._recordings:
            path = f"/projects/{self._evaluation.project}/{Kind.CLIP.plural}/{item}"
            found = self._evaluation.transport.get(type(self._evaluation.item), path)
            clip = ClipHandle(self._evaluation.transport, self._evaluation.project, found)
            self._recordings[item, revision] = ClipOfStrip(clip, revision)
        return self._recordings[item, revision]


def mirrored(clip: Any) -> Any:
    """Return the mirrored copy of a clip of `marey_motion`."""
    rigs = import_optional("marey_motion.rigs", FIGURES_EXTRA)
    partners = rigs.symmetric_joints(clip.skeleton, rigs.map_joints(clip.skeleton))
    return import_optional("marey_motion.mirroring", FIGURES_EXTRA).mirror_clip(clip, partners)


def _spread(frames: range, moments: int, name: str) -> list[int]:
    """Return up to `moments` evenly spaced frames of a range. Raises `BadArgument` if the range is empty."""
    if not 1 <= moments <= MOST_MOMENTS:
        raise BadArgument(f"moments: a picture shows 1 to {MOST_MOMENTS} moments, not {moments}")
    if not frames:
        raise BadArgument(
            f"frames: the range contains no frame of {name!r}; write first:end, with the first frame before the end, "
            "and within the clip"
        )
    return [frames[round(place)] for place in np.linspace(0, len(frames) - 1, min(moments, len(frames)))]


def _require_rows(count: int) -> None:
    if not 1 <= count <= MOST_ROWS:
        raise BadArgument(f"a picture shows 1 to {MOST_ROWS} rows, not {count}")


def _frame_of(motion: MotionDocument, frame: int) -> MotionDocument:
    translations = motion.translations
    one = slice(frame, frame + 1)
    return motion.model_copy(
        update={"poses": motion.poses[one], "translations": None if translations is None else translations[one]}
    )


def _posed(motion: MotionDocument, rig: PosedSkeleton) -> Any:
    documents = import_optional("marey_motion.documents", FIGURES_EXTRA)
    return documents.clip_from_document(motion, documents.skeleton_from_document(rig.hierarchy))


def _written(figure: Any, file_type: str, title: str) -> bytes:
    paper = import_optional("marey_reports.drawing.paper", FIGURES_EXTRA)
    if file_type == "svg":
        return str(paper.to_svg(figure, title)).encode()
    data: bytes = paper.to_png(figure)
    return data

"""Differences between revisions in words, for people who know motion but not the document."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from marey_schemas.documents.differences import (
    AnnotationDifference,
    Difference,
    Exceeding,
    FieldChange,
    FrameRun,
    JointChange,
    KeyframeChange,
    MappingDifference,
    ModelDifference,
    MotionDifference,
    Range,
    SegmentChange,
    SkeletonDifference,
)
from marey_schemas.wording import counted

MOST_LINES = 20
"""Most joints, segments or fields that are listed; the others are counted."""
MOST_SPANS = 4
"""Most times that are listed for a joint."""


def described(difference: Difference) -> Iterator[str]:
    """Yield lines that describe a difference: a heading, then a line for each change."""
    before, after = difference.before, difference.after
    same = before.item == after.item
    first = f"{before.name}: revision {before.revision}" if same else f"{before.name} revision {before.revision}"
    second = f"revision {after.revision}" if same else f"{after.name} revision {after.revision}"
    yield f"{first} → {second}"
    lines = list(_changes(difference))
    yield from lines or ["no difference"]


def _changes(difference: Difference) -> Iterator[str]:
    for part, change in difference.parts.items():
        if change != "changed":
            yield f"part {part}: {change}"
    if difference.motion is not None:
        yield from _motion(difference.motion, difference)
    if difference.skeleton is not None:
        yield from _skeleton(difference.skeleton)
    if difference.mapping is not None:
        yield from _mapping(difference.mapping)
    if difference.annotation is not None:
        yield from _annotation(difference.annotation)
    if difference.model is not None:
        yield from _model(difference.model)
    yield from _limited([_field(one) for one in difference.fields], "changed field", difference.more_fields)


def _limited(lines: Sequence[str], noun: str, more: int = 0) -> Iterator[str]:
    yield from lines[:MOST_LINES]
    left = len(lines) - len(lines[:MOST_LINES]) + more
    if left:
        yield f"and {counted(left, f'other {noun}')}"


# -- motions -----------------------------------------------------------------------------------------------------------


def _motion(motion: MotionDifference, difference: Difference) -> Iterator[str]:
    yield from _timing(motion)
    if motion.skeleton is not None:
        yield from _skeleton(motion.skeleton)
    if not any(run.change == "matched" for run in motion.runs):
        yield "no frame of one revision corresponds to a frame of the other"
        return
    rate_hz = motion.frame_rate_hz[1]
    yield from _joints(motion.rotations, "°", difference.options.threshold_deg, rate_hz, "joint")
    yield from _root(motion)
    yield from _joints(
        motion.translations, " cm", difference.options.threshold_cm, rate_hz, "translated joint", " moved"
    )
    if motion.translated_joints[0] != motion.translated_joints[1]:
        stored = [" ".join(names) or "none" for names in motion.translated_joints]
        yield f"joints with stored translations: {stored[0]} → {stored[1]}"


def _timing(motion: MotionDifference) -> Iterator[str]:
    rates = motion.frame_rate_hz
    if rates[0] != rates[1]:
        yield f"frame rate: {rates[0]:g} → {rates[1]:g} Hz"
    if motion.duration_ratio != 1.0:
        direction = "slower" if motion.duration_ratio > 1.0 else "faster"
        yield (
            f"re-timed: the same motion takes {motion.duration_ratio:.4g} times as long "
            f"(speed {1.0 / motion.duration_ratio:.4g}, {direction})"
        )
    yield from _limited([_run(run, motion) for run in motion.runs if run.change != "matched"], "range of frames")
    if motion.frames[0] != motion.frames[1] or motion.duration_s[0] != motion.duration_s[1]:
        yield (
            f"length: {motion.frames[0]:,} → {counted(motion.frames[1], 'frame')} "
            f"({motion.duration_s[0]:.2f} → {motion.duration_s[1]:.2f} s)"
        )


def _run(run: FrameRun, motion: MotionDifference) -> str:
    removed = run.change == "removed"
    start, stop = run.before if removed else run.after
    side = 0 if removed else 1
    frames, verb = stop - start, run.change
    if stop - start == motion.frames[side]:
        return f"all {counted(frames, 'frame')} {verb}"
    name = "trimmed" if removed else "extended"
    if start == 0:
        return f"{name}: first {counted(frames, 'frame')} {verb} ({frames / motion.frame_rate_hz[side]:.2f} s)"
    if stop == motion.frames[side]:
        return f"{name}: last {counted(frames, 'frame')} {verb} ({frames / motion.frame_rate_hz[side]:.2f} s)"
    where = _time(start, stop, motion.frame_rate_hz[side])
    return f"{counted(frames, 'frame')} {verb} {where}{' of the revision before' if removed else ''}"


def _joints(
    joints: Sequence[JointChange], unit: str, threshold: float, rate_hz: float, noun: str, verb: str = ""
) -> Iterator[str]:
    large = [one for one in joints if one.largest > threshold]
    yield from _limited([f"{one.joint}:{verb} {_size(one, unit, rate_hz)}" for one in large], noun)
    small = len(joints) - len(large)
    if small:
        other = "other " if large else ""
        yield f"{counted(small, f'{other}{noun}')}{verb}: up to {joints[len(large)].largest:.2g}{unit}"


def _size(change: Exceeding, unit: str, rate_hz: float) -> str:
    text = f"up to {change.largest:.3g}{unit}"
    if not change.spans:
        return text
    shown = ", ".join(_time(start, stop, rate_hz) for start, stop in change.spans[:MOST_SPANS])
    more = len(change.spans) - MOST_SPANS
    others = f" and {counted(more, 'other time')}" if more > 0 else ""
    return f"{text} {shown}{others}; mean {change.mean:.2g}{unit}"


def _time(start: int, stop: int, rate_hz: float) -> str:
    return f"between {start / rate_hz:.2f} s and {stop / rate_hz:.2f} s"


def _root(motion: MotionDifference) -> Iterator[str]:
    root = motion.root
    if root is None:
        return
    if root.moved is not None:
        x, y, z = root.moved.shift_cm
        turn = (
            f"turned by {root.moved.turn_deg:.3g}° about the vertical, then " if abs(root.moved.turn_deg) > 0.01 else ""
        )
        yield (
            f"path of the root: {turn}shifted by ({x:.1f}, {y:.1f}, {z:.1f}) cm as a whole; "
            f"apart from that up to {root.moved.remaining_cm:.2g} cm"
        )
    else:
        yield f"path of the root: {_size(root, ' cm', motion.frame_rate_hz[1])}"


# -- skeletons ---------------------------------------------------------------------------------------------------------


def _skeleton(skeleton: SkeletonDifference) -> Iterator[str]:
    if skeleton.joint_count[0] != skeleton.joint_count[1]:
        yield f"skeleton: {skeleton.joint_count[0]} → {counted(skeleton.joint_count[1], 'joint')}"
    for names, verb in ((skeleton.added, "added"), (skeleton.removed, "removed")):
        if names:
            yield f"{counted(len(names), 'joint')} {verb}: {_names(names)}"
    if skeleton.renamed:
        pairs = _names([f"{old} → {new}" for old, new in skeleton.renamed])
        yield f"{counted(len(skeleton.renamed), 'joint')} renamed: {pairs}"
    lines = []
    for one in skeleton.joints:
        changes = []
        if one.parent is not None:
            changes.append(f"parent {one.parent[0] or 'none'} → {one.parent[1] or 'none'}")
        if one.offset_cm:
            changes.append(f"offset by {one.offset_cm:.3g} cm")
        if one.rotation_deg:
            changes.append(f"rest rotation by {one.rotation_deg:.3g}°")
        lines.append(f"rest pose of {one.joint}: {', '.join(changes)}")
    yield from _limited(lines, "joint")
    if skeleton.reordered:
        yield "the joints are in another order"
    if skeleton.end_sites_changed:
        yield "the end sites of the joints differ"


def _names(names: Sequence[str]) -> str:
    more = len(names) - MOST_LINES
    return ", ".join(names[:MOST_LINES]) + (f" and {more} more" if more > 0 else "")


def _mapping(mapping: MappingDifference) -> Iterator[str]:
    lines = [f"{one.standard}: {one.before or 'no joint'} → {one.after or 'no joint'}" for one in mapping.joints]
    yield from _limited([f"mapping of {line}" for line in lines], "standard joint")
    if mapping.axes:
        yield f"axes of {counted(len(mapping.axes), 'joint')} changed: {_names(mapping.axes)}"


# -- annotations -------------------------------------------------------------------------------------------------------


def _annotation(annotation: AnnotationDifference) -> Iterator[str]:
    counts = annotation.segment_count
    if counts[0] != counts[1]:
        yield f"segments: {counts[0]} → {counts[1]}"
    shift = _common_shift(annotation.segments)
    rest: Sequence[SegmentChange] = annotation.segments
    if shift is not None:
        rest = [one for one in rest if _shift(one) != shift]
        yield f"{counted(len(annotation.segments) - len(rest), 'segment')} moved by {shift:+d} frames"
    yield from _limited([_segment(one) for one in rest], "segment")
    yield from _limited([_keyframe(one) for one in annotation.keyframes], "keyframe")


def _shift(change: SegmentChange) -> int | None:
    """Return the number of frames by which a segment moved without another change, or None."""
    old, new = change.before, change.after
    if old is None or new is None or old.label != new.label or new.start - old.start != new.end - old.end:
        return None
    return new.start - old.start


def _common_shift(changes: Sequence[SegmentChange]) -> int | None:
    """Return the shift that at least three segments, and most of the changed ones, have in common."""
    shifts = [shift for one in changes if (shift := _shift(one)) is not None]
    most = max(set(shifts), key=shifts.count, default=None)
    return most if most is not None and shifts.count(most) >= 3 and 2 * shifts.count(most) > len(changes) else None


def _segment(change: SegmentChange) -> str:
    old, new = change.before, change.after
    if old is None or new is None:
        one = old or new
        assert one is not None
        return f"segment {'added' if old is None else 'removed'}: {one.label}, frames {_frames((one.start, one.end))}"
    name = f"segment {old.label}" if old.label == new.label else f"segment relabelled: {old.label} → {new.label}"
    if (old.start, old.end) == (new.start, new.end):
        return f"{name}, frames {_frames((new.start, new.end))}"
    changes = [
        f"{edge} {frame} → {other} ({other - frame:+d})"
        for edge, frame, other in (("start", old.start, new.start), ("end", old.end, new.end))
        if frame != other
    ]
    return f"{name}: {', '.join(changes)}"


def _frames(frames: Range) -> str:
    return f"{frames[0]} to {frames[1] - 1}"


def _keyframe(change: KeyframeChange) -> str:
    old, new = change.before, change.after
    if old is None or new is None:
        one = old or new
        assert one is not None
        return f"keyframe {'added' if old is None else 'removed'}: {one.label}, frame {one.frame}"
    if old.label != new.label:
        return f"keyframe relabelled: {old.label} → {new.label}, frame {new.frame}"
    return f"keyframe {old.label}: frame {old.frame} → {new.frame} ({new.frame - old.frame:+d})"


# -- models and fields -------------------------------------------------------------------------------------------------


def _model(model: ModelDifference) -> Iterator[str]:
    if model.examples[0] != model.examples[1]:
        yield f"training examples: {model.examples[0]} → {model.examples[1]}"
    for names, verb in ((model.examples_added, "added"), (model.examples_removed, "removed")):
        if names:
            yield f"{counted(len(names), 'training example')} {verb}: {_names(names)}"
    before, after = model.mean_log_likelihood
    if before is not None and after is not None and before != after:
        yield f"mean log-likelihood of the training examples: {before:.4g} → {after:.4g} ({after - before:+.3g})"


def _field(change: FieldChange) -> str:
    place = f"{change.part}{change.pointer}"
    if change.change == "added":
        return f"{place} added: {_value(change.after)}"
    if change.change == "removed":
        return f"{place} removed: {_value(change.before)}"
    return f"{place}: {_value(change.before)} → {_value(change.after)}"


def _value(value: object) -> str:
    text = str(value) if not isinstance(value, str) else (value or "nothing")
    return text if len(text) <= 120 else f"{text[:117]}..."

"""Descriptions of differences between revisions as sentences, in terms of motion instead of fields of documents."""

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

NO_DIFFERENCE = "no difference"
MOST_LINES = 20
"""Greatest number of joints, segments or fields that are listed; of all further ones, only the number is printed."""
MOST_SPANS = 3
"""Greatest number of time ranges that are listed for a joint."""
LEAST_TURN_DEG = 0.05
LEAST_SHIFT_CM = 0.05
THROUGHOUT = 0.95
"""Share of the matched frames in which a change must exceed the threshold to be described as `throughout`."""


def described(difference: Difference) -> Iterator[str]:
    """Yield lines that describe a difference: a heading, then a line for each change."""
    before, after = difference.before, difference.after
    same = before.item == after.item
    first = f"{before.name}: revision {before.revision}" if same else f"{before.name} revision {before.revision}"
    second = f"revision {after.revision}" if same else f"{after.name} revision {after.revision}"
    yield f"{first} → {second}"
    yield from changes_in_words(difference)


def changes_in_words(difference: Difference) -> Iterator[str]:
    """Yield one line of text for each change, or the single line `no difference`."""
    lines = list(_changes(difference))
    yield from lines or [NO_DIFFERENCE]


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
    yield from _fields(difference)


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
    yield from _joints(motion.rotations, "°", difference.options.threshold_deg, motion, "joint")
    yield from _path(motion, difference.options.threshold_cm)
    yield from _joints(
        motion.translations, " cm", difference.options.threshold_cm, motion, "translated joint", " moved"
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
    yield from _limited(list(_unmatched(motion)), "range")
    if motion.frames[0] != motion.frames[1] or motion.duration_s[0] != motion.duration_s[1]:
        yield (
            f"length: {motion.frames[0]:,} → {counted(motion.frames[1], 'frame')} "
            f"({motion.duration_s[0]:.2f} → {motion.duration_s[1]:.2f} s)"
        )


def _run(run: FrameRun, motion: MotionDifference) -> str:
    removed = run.change == "removed"
    start, stop = run.before if removed else run.after
    side = 0 if removed else 1
    frames, verb, seconds = counted(stop - start, "frame"), run.change, (stop - start) / motion.frame_rate_hz[side]
    if stop - start == motion.frames[side]:
        return f"all {frames} {verb}"
    name = "trimmed" if removed else "extended"
    if start == 0:
        return f"{name}: first {frames} {verb} ({seconds:.2f} s)"
    if stop == motion.frames[side]:
        return f"{name}: last {frames} {verb} ({seconds:.2f} s)"
    where = _time(start, stop, motion.frame_rate_hz[side])
    return f"{frames} {verb} {where}{' of the earlier revision' if removed else ''}"


def _unmatched(motion: MotionDifference) -> Iterator[str]:
    """Yield lines about removed and inserted frames; if both are at the same place, the line says "replaced"."""
    runs = iter([*motion.runs, None])
    run = next(runs)
    while run is not None:
        following = next(runs)
        if run.change == "removed" and following is not None and following.change == "inserted":
            where = _time(*following.after, motion.frame_rate_hz[1])
            old, new = run.before[1] - run.before[0], following.after[1] - following.after[0]
            yield f"replaced: {counted(old, 'frame')} by {new:,} new ones, {where}"
            following = next(runs)
        elif run.change != "matched":
            yield _run(run, motion)
        run = following


def _joints(
    joints: Sequence[JointChange], unit: str, threshold: float, motion: MotionDifference, noun: str, verb: str = ""
) -> Iterator[str]:
    large = [one for one in joints if one.largest > threshold]
    yield from _limited([f"{one.joint}:{verb} {_size(one, unit, threshold, motion)}" for one in large], noun)
    small = len(joints) - len(large)
    if small:
        other = "other " if large else ""
        yield f"{counted(small, f'{other}{noun}')}:{verb} up to {_number(joints[len(large)].largest)}{unit}"


def _size(change: Exceeding, unit: str, threshold: float, motion: MotionDifference) -> str:
    rate_hz = motion.frame_rate_hz[1]
    matched = sum(run.after[1] - run.after[0] for run in motion.runs if run.change == "matched")
    text = f"up to {_number(change.largest)}{unit}"
    if not change.spans:
        return text
    mean = f", mean {_number(change.mean)}{unit}"
    if sum(stop - start for start, stop in change.spans) >= THROUGHOUT * matched:
        return f"{text} throughout{mean}"
    if len(change.spans) > MOST_SPANS:
        whole = _time(change.spans[0][0], change.spans[-1][1], rate_hz)
        times = f"above {threshold:g}{unit} {len(change.spans)} times {whole}"
        return f"{text} at {change.largest_at / rate_hz:.2f} s, {times}{mean}"
    return f"{text} {' and '.join(_time(start, stop, rate_hz) for start, stop in change.spans)}{mean}"


def _number(value: float) -> str:
    """Return a number with three significant digits, or with all integer digits if the number has more than three."""
    return f"{value:.3g}" if value < 999.5 else f"{value:,.0f}"


def _time(start: int, stop: int, rate_hz: float) -> str:
    return f"between {start / rate_hz:.2f} s and {stop / rate_hz:.2f} s"


def _path(motion: MotionDifference, threshold_cm: float) -> Iterator[str]:
    path = motion.path
    if path is None:
        return
    if path.moved is None:
        yield f"path of {path.joint}: {_size(path, ' cm', threshold_cm, motion)}"
        return
    moves = []
    if abs(path.moved.turn_deg) > LEAST_TURN_DEG:
        moves.append(f"turned {'left' if path.moved.turn_deg > 0 else 'right'} by {abs(path.moved.turn_deg):.4g}°")
    if any(abs(shift) > LEAST_SHIFT_CM for shift in path.moved.shift_cm):
        x, y, z = (f"{shift:.1f}".replace("-0.0", "0.0") for shift in path.moved.shift_cm)
        moves.append(f"shifted by x {x}, y {y}, z {z} cm")
    left = path.moved.remaining_cm
    rest = f", otherwise changed by up to {_number(left)} cm" if left > LEAST_SHIFT_CM else ""
    yield f"whole path of {path.joint}: {' and '.join(moves) or 'moved'}{rest}"


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
            changes.append(f"offset changed by {one.offset_cm:.3g} cm")
        if one.rotation_deg:
            changes.append(f"rest rotation changed by {one.rotation_deg:.3g}°")
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
    """Return the number of frames by which a segment moved; None for any other change, also of label or length."""
    old, new = change.before, change.after
    if old is None or new is None or old.label != new.label or new.start - old.start != new.end - old.end:
        return None
    return new.start - old.start


def _common_shift(changes: Sequence[SegmentChange]) -> int | None:
    """Return the shift in frames that at least three changes, and more than half of all, have in common; or None."""
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


def _fields(difference: Difference) -> Iterator[str]:
    """Yield one line per changed field; import warnings of a clip, and details of its source, are summarised."""
    checks = [one for one in difference.fields if one.part == "info" and one.pointer.startswith("/checks/")]
    source = [one for one in difference.fields if one.part == "info" and one.pointer.startswith("/source/details")]
    for change, verb in (("removed", "no longer listed"), ("added", "added"), ("changed", "changed")):
        found = [one for one in checks if one.change == change]
        if found:
            yield f"{counted(len(found), 'warning')} {verb}: {_names(list(dict.fromkeys(map(_check, found))))}"
    rest = [one for one in difference.fields if one not in checks and one not in source]
    yield from _limited([_field(one) for one in rest], "changed field", difference.more_fields)
    if source:
        yield f"{counted(len(source), 'value')} in the details of the clip's source changed; --json lists them"


def _check(change: FieldChange) -> str:
    """Return the code of an import warning that was added or removed; for other changes, the JSON pointer."""
    value = change.after if change.before is None else change.before
    return str(value["code"]) if isinstance(value, dict) and "code" in value else change.pointer


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

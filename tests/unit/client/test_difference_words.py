"""Differences in words: one line for each change. Readers understand the line without the document."""

from typing import Any

import pytest

from marey_client.cli.difference.words import described
from marey_schemas.documents.differences import Difference

MOTION: dict[str, Any] = {
    "frames": (240, 240), "frame_rate_hz": (60.0, 60.0), "duration_s": (4.0, 4.0),
    "runs": [{"change": "matched", "before": (0, 240), "after": (0, 240)}],
}  # fmt: skip


def lines_of(**members: Any) -> list[str]:
    sides = {name: {"item": "clip_x", "name": "walk", "revision": n} for name, n in (("before", 1), ("after", 3))}
    given = {"kind": "clip", "options": {}, "parts": {"motion": "changed"}, **sides, **members}
    heading, *lines = described(Difference.model_validate(given))
    assert heading == "walk: revision 1 → revision 3"
    return lines


def lines_of_motion(**members: Any) -> list[str]:
    return lines_of(motion={**MOTION, **members})


def joint(name: str, largest: float, *spans: tuple[int, int]) -> dict[str, Any]:
    return {"joint": name, "mean": largest / 10, "largest": largest, "largest_at": 90, "spans": spans}


def test_equal_revisions_have_no_difference() -> None:
    assert lines_of(parts={}) == ["no difference"]


def test_the_heading_names_both_items() -> None:
    sides = {name: {"item": name, "name": name, "revision": 2} for name in ("before", "after")}
    found = Difference.model_validate({"kind": "clip", "options": {}, "parts": {}, **sides})
    assert next(described(found)) == "before revision 2 → after revision 2"


@pytest.mark.parametrize(
    ("change", "before", "after", "line"),
    [
        ("removed", (0, 12), (0, 0), "trimmed: first 12 frames removed (0.20 s)"),
        ("removed", (239, 240), (239, 239), "trimmed: last 1 frame removed (0.02 s)"),
        ("removed", (60, 90), (60, 60), "30 frames removed between 1.00 s and 1.50 s of the earlier revision"),
        ("inserted", (0, 0), (0, 6), "extended: first 6 frames inserted (0.10 s)"),
        ("inserted", (240, 240), (180, 240), "extended: last 60 frames inserted (1.00 s)"),
        ("inserted", (60, 60), (60, 90), "30 frames inserted between 1.00 s and 1.50 s"),
        ("removed", (0, 240), (0, 0), "all 240 frames removed"),
    ],
)
def test_removed_and_inserted_frames_have_their_place(change: str, before: Any, after: Any, line: str) -> None:
    matched = MOTION["runs"]
    assert lines_of_motion(runs=[*matched, {"change": change, "before": before, "after": after}]) == [line]


def test_frames_removed_and_inserted_at_one_place_are_replaced() -> None:
    runs = [
        *MOTION["runs"],
        {"change": "removed", "before": (60, 90), "after": (60, 60)},
        {"change": "inserted", "before": (90, 90), "after": (60, 120)},
    ]
    line = "replaced: 30 frames by 60 new ones, between 1.00 s and 2.00 s"
    assert lines_of_motion(runs=runs) == [line]


def test_clips_without_corresponding_frames_are_not_compared_further() -> None:
    runs = [{"change": "removed", "before": (0, 240), "after": (0, 0)}]
    lines = lines_of_motion(runs=runs)
    assert lines[-1] == "no frame of one revision corresponds to a frame of the other"


def test_joints_have_their_largest_change_and_its_times() -> None:
    rotations = [
        joint("LeftArm", 14.23, (78, 126)),
        joint("LeftHand", 9.0, (0, 240)),
        joint("Head", 5.0, *((20 * place, 20 * place + 5) for place in range(6))),
        joint("Neck", 0.4),
        joint("Spine", 0.2),
    ]
    assert lines_of_motion(rotations=rotations) == [
        "LeftArm: up to 14.2° between 1.30 s and 2.10 s, mean 1.42°",
        "LeftHand: up to 9° throughout, mean 0.9°",
        "Head: up to 5° at 1.50 s, above 1° 6 times between 0.00 s and 1.75 s, mean 0.5°",
        "2 other joints: up to 0.4°",
    ]


def test_joints_beyond_the_first_twenty_are_counted() -> None:
    lines = lines_of_motion(rotations=[joint(f"Joint{number}", 10.0, (0, 9)) for number in range(23)])
    assert len(lines) == 21
    assert lines[-1] == "and 3 other joints"


def test_paths_moved_as_a_whole_are_told_from_paths_that_changed_in_places() -> None:
    path = {**joint("Hips", 5000.0, (0, 240))}
    moved = {"turn_deg": -30.0, "shift_cm": (50.0, -0.01, 20.0), "remaining_cm": 0.3}
    assert lines_of_motion(path={**path, "moved": moved}) == [
        "whole path of Hips: turned right by 30° and shifted by x 50.0, y 0.0, z 20.0 cm, "
        "otherwise changed by up to 0.3 cm"
    ]
    assert lines_of_motion(path=path) == ["path of Hips: up to 5,000 cm throughout, mean 500 cm"]


def test_timing_distinguishes_the_rate_from_the_speed() -> None:
    members = {"frames": (240, 192), "duration_s": (4.0, 3.2), "frames_per_frame": 0.8, "duration_ratio": 0.8}
    assert lines_of_motion(**members) == [
        "re-timed: the same motion takes 0.8 times as long (speed 1.25, faster)",
        "length: 240 → 192 frames (4.00 → 3.20 s)",
    ]
    rates = lines_of_motion(frames=(240, 120), frame_rate_hz=(60.0, 30.0), frames_per_frame=0.5)
    assert rates == ["frame rate: 60 → 30 Hz", "length: 240 → 120 frames (4.00 → 4.00 s)"]


def test_skeletons_and_mappings_name_their_joints() -> None:
    skeleton = {
        "joint_count": (22, 23),
        "added": ("Tail", "Tip"),
        "removed": ("Prop",),
        "renamed": (("LeftArm", "ArmL"),),
        "joints": [{"joint": "Head", "parent": ("Neck1", "Neck"), "offset_cm": 2.0, "rotation_deg": 5.0}],
        "end_sites_changed": True,
    }
    mapping = {"joints": [{"standard": "head", "before": "Head"}], "axes": ("Head",)}
    assert lines_of(skeleton=skeleton, mapping=mapping) == [
        "skeleton: 22 → 23 joints",
        "2 joints added: Tail, Tip",
        "1 joint removed: Prop",
        "1 joint renamed: LeftArm → ArmL",
        "rest pose of Head: parent Neck1 → Neck, offset changed by 2 cm, rest rotation changed by 5°",
        "the end sites of the joints differ",
        "mapping of head: Head → no joint",
        "axes of 1 joint changed: Head",
    ]


def segment(label: str, start: int, end: int) -> dict[str, Any]:
    return {"label": label, "start": start, "end": end}


def test_segments_and_keyframes_name_what_changed() -> None:
    annotation = {
        "segment_count": (4, 4),
        "segments": [
            {"before": segment("idle", 0, 80), "after": segment("idle", 0, 90)},
            {"before": segment("walk", 80, 200), "after": segment("run", 80, 200)},
            {"before": segment("turn", 200, 260)},
            {"after": segment("jump", 260, 300)},
        ],
        "keyframe_count": (2, 2),
        "keyframes": [
            {"before": {"label": "contact", "frame": 10}, "after": {"label": "contact", "frame": 14}},
            {"before": {"label": "lift", "frame": 30}, "after": {"label": "raise", "frame": 30}},
        ],
    }
    assert lines_of(annotation=annotation) == [
        "segment idle: end 80 → 90 (+10)",
        "segment relabelled: walk → run, frames 80 to 199",
        "segment removed: turn, frames 200 to 259",
        "segment added: jump, frames 260 to 299",
        "keyframe contact: frame 10 → 14 (+4)",
        "keyframe relabelled: lift → raise, frame 30",
    ]


def test_a_shift_that_segments_have_in_common_is_one_line() -> None:
    moved = [
        {
            "before": segment("step", 20 * place, 20 * place + 9),
            "after": segment("step", 20 * place - 12, 20 * place - 3),
        }
        for place in range(1, 6)
    ]
    annotation = {"segment_count": (5, 5), "segments": moved, "keyframe_count": (0, 0)}
    assert lines_of(annotation=annotation) == ["5 segments moved by -12 frames"]


def test_models_and_fields_have_their_values() -> None:
    model = {
        "examples": (3, 4), "examples_added": ("walk-4",), "examples_removed": (), "mean_log_likelihood": (-10.0, -8.5),
    }  # fmt: skip
    fields = [
        {"part": "model", "pointer": "/options/components", "change": "changed", "before": 4, "after": 6},
        {"part": "model", "pointer": "/verdict", "change": "removed", "before": "good"},
    ]
    assert lines_of(model=model, fields=fields, more_fields=2) == [
        "training examples: 3 → 4",
        "1 training example added: walk-4",
        "mean log-likelihood of the training examples: -10 → -8.5 (+1.5)",
        "model/options/components: 4 → 6",
        "model/verdict removed: good",
        "and 2 other changed fields",
    ]


def test_findings_of_the_import_and_details_of_the_source_are_summarised() -> None:
    checks = [
        {"part": "info", "pointer": f"/checks/{place}", "change": "removed", "before": {"code": code}}
        for place, code in enumerate(("foot-slide", "unit-inferred"))
    ]
    source = {"part": "info", "pointer": "/source/details/x", "change": "added", "after": 1}
    action = {"part": "info", "pointer": "/action", "change": "changed", "before": "", "after": "walk"}
    assert lines_of(fields=[*checks, source, action]) == [
        "2 warnings no longer listed: foot-slide, unit-inferred",
        "info/action: nothing → walk",
        "1 value in the details of the clip's source changed; --json lists them",
    ]


def test_parts_that_only_one_revision_has_are_named() -> None:
    assert lines_of(parts={"info": "added", "mapping": "removed"}) == ["part info: added", "part mapping: removed"]

"""Contact sheets (a row of small figures for each clip): their contents, and that any clip can be drawn."""

import io
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.text import Annotation
from tests.support.present import present
from tests.support.real_takes import read_takes

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats, Ints
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.gait import game_skeleton, generate_gait, studio_skeleton
from marey_motion.rigs import map_joints
from marey_motion.skeleton import EndSite, Skeleton
from marey_reports.drawing import contact_sheet as sheets
from marey_reports.drawing.contact_sheet import (
    BONE_POINTS,
    DPI,
    HEADER,
    MARGIN,
    PAGE_WIDTH,
    ROW,
    STAGE,
    TITLE,
    TakePair,
    contact_sheet,
)
from marey_reports.drawing.stick_figures import CENTRE, LEFT, RIGHT, Camera, body_of, stances_at

BLUE, ORANGE = (0x1F, 0x6F, 0xB2), (0xE0, 0x7B, 0x1A)


@pytest.fixture(scope="module")
def walk() -> Clip:
    return generate_gait(1.3, 0.4, 2.0)


def pixels_of(png: bytes) -> Ints:
    return np.rint(imread(io.BytesIO(png))[..., :3] * 255).astype(int)


def cell(pixels: Ints, row: int, column: int, columns: int) -> Ints:
    """Return the pixels around one figure; `columns` is the number of figures in a row."""
    width = (PAGE_WIDTH - 2 * MARGIN) / columns
    left, top = MARGIN + column * width, HEADER + row * ROW + TITLE
    return pixels[round(top * DPI) : round((top + STAGE) * DPI), round(left * DPI) : round((left + width) * DPI)]


def share_of(pixels: Ints, colour: tuple[int, int, int]) -> float:
    return np.mean(np.abs(pixels - colour).max(axis=-1) < 12)


def chain(names: tuple[Any, ...], offsets: list[tuple[float, float, float]], tips: tuple[Any, ...] = ()) -> Skeleton:
    count = len(names)
    return Skeleton(
        names, np.arange(-1, count - 1, dtype=np.int32), np.array(offsets), quaternions.identity(count), tips
    )


def still(skeleton: Skeleton, frames: int = 3) -> Clip:
    pose = np.concatenate((skeleton.offsets[0], skeleton.rest_rotations.ravel()))
    return Clip(skeleton, 30.0, np.tile(pose, (frames, 1)))


def test_each_take_has_a_row_with_figures_of_both_sides_in_every_cell(walk: Clip) -> None:
    png = contact_sheet([TakePair("one", walk, walk), TakePair("two", walk, walk)], moments=3)

    pixels = pixels_of(png)
    assert png.startswith(b"\x89PNG")
    assert pixels.shape[:2] == (round((HEADER + 2 * ROW) * DPI), round(PAGE_WIDTH * DPI))
    for row in range(2):
        for column in range(6):
            figure = cell(pixels, row, column, 6)
            assert share_of(figure, BLUE) > 0.003
            assert share_of(figure, ORANGE) > 0.003


def test_source_and_result_are_drawn_at_one_scale(walk: Clip) -> None:
    small = generate_gait(1.3, 0.4, 2.0, stature_m=0.9)
    pixels = pixels_of(contact_sheet([TakePair("", walk, small)], moments=2))

    def height(column: int) -> np.int64:
        dark = np.abs(cell(pixels, 0, column, 4) - BLUE).max(axis=-1) < 12
        return np.ptp(np.flatnonzero(dark.any(axis=1)))

    assert height(1) == pytest.approx(0.9 / 1.78 * height(0), rel=0.1)


def test_outstretched_arms_stay_in_their_cell() -> None:
    rest = still(studio_skeleton(), frames=6)
    pixels = pixels_of(contact_sheet([TakePair("", rest, rest)], moments=6))
    for column in range(12):
        figure = cell(pixels, 0, column, 12)
        sides = np.concatenate((figure[:, :4], figure[:, -4:]), axis=1)
        assert share_of(figure, BLUE) > 0.002
        assert share_of(sides, BLUE) == share_of(sides, ORANGE) == 0


def test_a_title_is_taken_literally_and_a_long_one_is_cut(walk: Clip) -> None:
    contact_sheet([TakePair(r"cost $5 and \frac{1}{0} ^_ {", walk, walk), TakePair("x" * 5000, walk, walk)])


@pytest.mark.parametrize(
    ("total", "said"), [(None, "1 take, each"), (1, "1 take, each"), (24, "1 of 24 takes, the worst first, each")]
)
def test_a_sheet_says_how_many_of_all_takes_it_shows(
    walk: Clip, monkeypatch: pytest.MonkeyPatch, total: int | None, said: str
) -> None:
    texts = written_texts(monkeypatch)
    contact_sheet([TakePair("walk", walk, walk)], moments=1, total=total, choice="the worst first")
    assert any(text.startswith(said) for text in texts)


def test_a_sheet_says_which_clip_is_on_which_background(walk: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = written_texts(monkeypatch)
    contact_sheet([TakePair("", walk, walk)], moments=1)
    assert "1 take, each moment as source (white) and result (tinted)" in texts
    contact_sheet([TakePair("", walk, walk)], moments=1, sides=("dogs/trot", "walks/" + 50 * "x"))
    assert f"1 take, each moment as dogs/trot (white) and walks/{9 * 'x'}…{14 * 'x'} (tinted)" in texts


def written_texts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list to which all texts are added that sheets contain from now on."""
    texts: list[str] = []
    original = sheets._write

    def written(axes: Any, place: Any, text: str, *arguments: Any, **options: Any) -> Any:
        texts.append(text)
        return original(axes, place, text, *arguments, **options)

    monkeypatch.setattr(sheets, "_write", written)
    return texts


def test_the_same_takes_give_the_same_picture_in_many_threads(walk: Clip) -> None:
    takes = [TakePair("walk", walk, walk)]

    with ThreadPoolExecutor(4) as pool:
        sheets = list(pool.map(lambda _: contact_sheet(takes, moments=2), range(4)))
    assert len(set(sheets)) == 1


def test_only_the_frames_shown_are_computed(walk: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    computed = []
    from marey_motion import kinematics

    original = kinematics.forward_kinematics

    def counted(skeleton: Skeleton, poses: AnyFloats, **options: Any) -> Any:
        computed.append(len(poses))
        return original(skeleton, poses, **options)

    monkeypatch.setattr(kinematics, "forward_kinematics", counted)
    contact_sheet([TakePair("long", walk, walk)], moments=5)
    assert computed == [5, 5]


def test_clips_of_one_frame_of_one_joint_and_of_no_extent_are_drawn() -> None:
    point = chain(("point",), [(0.0, 0.0, 0.0)])
    stick = chain(("a", "b"), [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0)], (EndSite(1, np.array((0.0, 0.5, 0.0))),))

    for skeleton in (point, stick):
        clip = still(skeleton, frames=1)
        assert contact_sheet([TakePair("tiny", clip, clip)]).startswith(b"\x89PNG")


def test_a_clip_of_two_frames_is_shown_at_two_moments(walk: Clip) -> None:
    pixels = pixels_of(contact_sheet([TakePair("short", walk.sliced(0, 2), walk.sliced(0, 2))], moments=4))

    assert share_of(cell(pixels, 0, 3, 8), BLUE) > 0.003
    assert share_of(cell(pixels, 0, 4, 8), BLUE) == 0.0


def test_figures_below_the_floor_stay_on_their_ground(walk: Clip) -> None:
    poses = walk.poses.copy()
    poses[:, 1] -= 1.5
    pixels = pixels_of(contact_sheet([TakePair("sunk", replace(walk, poses=poses), walk)], moments=2))

    assert share_of(cell(pixels, 0, 0, 4), BLUE) > 0.001


@pytest.mark.parametrize(("count", "moments"), [(0, 6), (101, 6), (1, 0), (1, 13)])
def test_a_sheet_of_nothing_or_of_too_much_is_refused(walk: Clip, count: int, moments: int) -> None:
    with pytest.raises(MotionError, match="1 to 100 takes at 1 to 12 moments"):
        contact_sheet([TakePair("", walk, walk)] * count, moments=moments)


def test_props_and_roots_on_the_floor_are_no_part_of_a_body() -> None:
    skeleton = game_skeleton()
    body = body_of(skeleton)

    drawn = {skeleton.joint_names[joint] for joint in body.bones[:, 0] if joint < skeleton.joint_count}
    assert not {"root", "pelvis", "weapon_r", "upperarm_twist_01_l"} & drawn
    assert {"spine_02", "neck_02", "calf_l", "hand_r", "head"} <= drawn


def test_bones_have_the_side_of_the_body_they_belong_to() -> None:
    skeleton = game_skeleton()
    body = body_of(skeleton)

    sides = {
        skeleton.joint_names[outer]: side
        for (outer, _), side in zip(body.bones, body.sides, strict=True)
        if outer < skeleton.joint_count
    }
    assert sides["thigh_l"] == sides["clavicle_l"] == LEFT
    assert sides["thigh_r"] == sides["hand_r"] == RIGHT
    assert sides["spine_02"] == sides["spine_04"] == sides["head"] == CENTRE


def test_a_body_without_names_or_limbs_is_drawn_whole() -> None:
    skeleton = chain(("a", "b", "c"), [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)])

    assert body_of(skeleton).bones.tolist() == [[1, 0], [2, 1]]
    assert stances_at(still(skeleton), body_of(skeleton), np.array([0])).facing is None


def test_figures_are_centred_on_the_pelvis_and_face_their_heading() -> None:
    clip = generate_gait(2.0, np.pi / 4, 4.0)
    stances = stances_at(clip, body_of(clip.skeleton), np.array([0, 120]))

    assert np.abs(stances.points[:, 0, ::2]).max() < 1e-12
    assert present(stances.facing)[0] == pytest.approx((0.0, 1.0), abs=0.05)
    assert present(stances.facing)[1] == pytest.approx((1.0, 0.0), abs=0.05)


def test_a_camera_in_front_sees_the_left_side_on_the_right_and_near_things_lower() -> None:
    camera = Camera(direction_rad=0.0, tilt_rad=np.radians(10))

    left, near, up = camera.seen(np.eye(3)[[0, 2, 1]])
    assert left == pytest.approx((1.0, 0.0, 0.0))
    assert near[1] < 0.0 < near[2]
    assert up[1] > 0.9


def test_a_body_lying_on_its_side_is_drawn_without_an_arrow() -> None:
    clip = still(studio_skeleton())
    poses = clip.poses.copy()
    poses[:, 3:7] = quaternions.from_axis_angle((0.0, 0.0, 1.0), np.pi / 2)
    lying = replace(clip, poses=poses)

    assert stances_at(lying, body_of(lying.skeleton), np.array([0])).facing is None
    assert contact_sheet([TakePair("lying", lying, clip)]).startswith(b"\x89PNG")


def raised(clip: Clip, axis: tuple[float, float, float], turn_rad: float) -> Clip:
    """Return a clip whose upper arms are turned about an axis, both alike."""
    poses = clip.poses.copy()
    mapping = map_joints(clip.skeleton)
    for joint in mapping.indices(clip.skeleton, ["left_shoulder", "right_shoulder"]):
        own = slice(3 + 4 * joint, 7 + 4 * joint)
        poses[:, own] = quaternions.multiply(quaternions.from_axis_angle(axis, turn_rad), poses[:, own])
    return replace(clip, poses=poses)


def lifted(clip: Clip, metres: float) -> Clip:
    poses = clip.poses.copy()
    poses[:, 1] += metres
    return replace(clip, poses=poses)


def toppled(clip: Clip, axis: tuple[float, float, float]) -> Clip:
    poses = clip.poses.copy()
    poses[:, 3:7] = quaternions.multiply(quaternions.from_axis_angle(axis, np.pi / 2), poses[:, 3:7])
    return replace(clip, poses=poses)


def beyond_their_cells(figure: Figure) -> list[str]:
    """Return the parts of bodies, floors and arrows that leave the cell in which most of them lies."""
    (axes,) = figure.axes
    cells = np.array([patch.get_bbox().get_points() for patch in axes.patches if isinstance(patch, Rectangle)])
    parts: list[tuple[str, Any]] = []
    for lines in axes.collections:
        assert isinstance(lines, LineCollection)
        parts.append(("bones", np.concatenate(lines.get_segments())))
    for patch in axes.patches:
        if isinstance(patch, Ellipse):  # heads and patches of floor
            half = 0.5 * np.array((patch.width, patch.height))
            parts.append((type(patch).__name__, np.stack((patch.center - half, patch.center + half))))
    below = float(cells[:, 1, 1].max())
    arrows = [note for note in axes.texts if isinstance(note, Annotation) and note.xy[1] < below]
    parts += [("arrow", np.array((note.xy, note.xyann))) for note in arrows]
    assert len(parts) >= 3 * len(cells)
    line = 0.5 * BONE_POINTS / 72.0
    found = []
    for name, points in parts:
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        low, high = cells[np.argmin(np.linalg.norm(cells.mean(axis=1) - middle, axis=1))]
        if (points < low + line).any() or (points > high - line).any():
            found.append(name)
    return found


@pytest.mark.every_nth(2)
@pytest.mark.parametrize("moments", [6, 12])
def test_no_pose_no_floor_and_no_arrow_leaves_its_cell(
    walk: Clip, monkeypatch: pytest.MonkeyPatch, moments: int
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(sheets, "to_png", drawn.append)
    upright, ahead, aside = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    clips = [
        walk, *(raised(walk, axis, turn) for axis in (upright, ahead, aside) for turn in (-2.5, -1.2, 1.2, 2.5)),
        *(toppled(walk, axis) for axis in (ahead, aside)), lifted(walk, -1.5), lifted(walk, 2.0),
    ]  # fmt: skip
    for clip in clips:
        contact_sheet([TakePair("a take", clip, walk)], moments=moments)
    assert [beyond_their_cells(figure) for figure in drawn] == [[]] * len(clips)


def test_no_real_pose_leaves_its_cell(mocap: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(sheets, "to_png", drawn.append)
    takes = read_takes(mocap, "cmu-amc/49/*", "bandai-namco-1/*.bvh")[:12]
    assert len(takes) > 3
    contact_sheet([TakePair(take.name, take.clip, take.clip) for take in takes], total=130, choice="the worst first")
    assert beyond_their_cells(drawn[0]) == []

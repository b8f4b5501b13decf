"""Strips of small figures: where the bodies are on the page, and which parts of a body are drawn."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle, PathPatch
from tests.support.drawn_figures import cut_off
from tests.support.present import present

from marey_motion import kinematics
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.gait import generate_gait
from marey_motion.skeleton import Skeleton
from marey_reports.drawing.paper import COLOURS, INK, REFERENCE
from marey_reports.drawing.stick_figures import body_of, runs_of
from marey_reports.drawing.strips import POSE_CELL_IN, PoseRow, StripMoments, StripRow, draw_pose_rows, draw_strips


@pytest.fixture(scope="module")
def walk() -> tuple[Skeleton, Floats]:
    clip = generate_gait(1.2, 0.0, 1.0)
    return clip.skeleton, kinematics.global_positions(clip, end_sites=True).astype(np.float64)


def strip(
    walk: tuple[Skeleton, Floats],
    *,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ghost: bool = False,
    copies: int = 1,
) -> Figure:
    skeleton, points = walk
    body = body_of(skeleton)
    shown = points[[0, 30, 59]]
    middles = shown[:, body.pelvis][:, [0, 2]]
    row = StripRow(
        "a walk", "", np.stack([shown + shift] * copies), points[None, :, body.pelvis], shown if ghost else None
    )
    return draw_strips(
        body, [row], StripMoments(middles, ["0 %", "50 %", "100 %"], ["", "", ""]), 0.0, cell_in=(1.2, 1.5)
    )


def coloured(figure: Figure, colour: str) -> list[PathPatch]:
    return [patch for patch in figure.axes[0].get_children() if isinstance(patch, PathPatch) and same(patch, colour)]


def points_of(patch: PathPatch) -> Floats:
    """Return the points (n, 2) of a drawn path, in inches."""
    return np.asarray(patch.get_path().vertices)


def same(patch: PathPatch, colour: str) -> bool:
    from matplotlib.colors import to_rgb

    return np.allclose(patch.get_edgecolor()[:3], to_rgb(colour))


def test_each_cell_has_a_body_with_a_left_a_right_and_a_middle(walk: tuple[Skeleton, Floats]) -> None:
    figure = strip(walk)
    for colour in (COLOURS[0], COLOURS[1], INK):
        assert len(coloured(figure, colour)) == 3
    assert sum(isinstance(patch, Circle) for patch in figure.axes[0].get_children()) == 3
    assert not cut_off(figure)


def test_the_circle_of_the_head_is_at_the_head_joint_or_half_way_to_its_tip(walk: tuple[Skeleton, Floats]) -> None:
    skeleton, points = walk
    head = skeleton.index_of("Head")
    tipless = replace(skeleton, end_sites=()), points[:, : skeleton.joint_count]
    assert (present(body_of(skeleton).head)[1], present(body_of(tipless[0]).head)[1]) == (0.5, 1.0)
    assert body_of(tipless[0]).bones[present(body_of(tipless[0]).head)[0], 0] == head
    for one, above in ((walk, True), (tipless, False)):
        figure = strip(one)
        circles = [patch for patch in figure.axes[0].get_children() if isinstance(patch, Circle)]
        for circle, middle in zip(circles, coloured(figure, INK), strict=True):
            vertices = points_of(middle)
            top = vertices[vertices[:, 1].argmax()]  # the head joint: the tip's bone is not drawn
            rise = np.asarray(circle.center) - top
            assert rise[1] > 0.01 if above else np.allclose(rise, 0.0)


def test_seen_from_ahead_the_left_side_is_on_the_right(walk: tuple[Skeleton, Floats]) -> None:
    figure = strip(walk)
    left, right = (np.mean([points_of(patch)[:, 0].mean() for patch in coloured(figure, colour)])
                   for colour in COLOURS[:2])  # fmt: skip
    assert left > right


def test_a_motion_that_is_elsewhere_stands_beside_the_ghost_of_the_other(walk: tuple[Skeleton, Floats]) -> None:
    moved = strip(walk, shift=(0.2, 0.0, 0.0), ghost=True)
    ghosts, lefts = coloured(moved, REFERENCE), coloured(moved, COLOURS[0])
    assert len(ghosts) == 9
    still = coloured(strip(walk, ghost=True), COLOURS[0])
    away = points_of(lefts[0])[:, 0].mean() - points_of(still[0])[:, 0].mean()
    assert away > 0.05  # inches: to the viewer's right is the body's left


def test_feet_stand_on_the_line_of_the_floor(walk: tuple[Skeleton, Floats]) -> None:
    figure = strip(walk)
    heights = [np.asarray(line.get_ydata()) for line in figure.axes[0].lines]
    floors = [line[0] for line in heights if len(set(line)) == 1]
    lowest = min(points_of(patch)[:, 1].min() for patch in coloured(figure, COLOURS[0]))
    assert lowest == pytest.approx(min(floors), abs=0.1)


def test_many_bodies_on_top_of_each_other_are_pale(walk: tuple[Skeleton, Floats]) -> None:
    one, many = coloured(strip(walk), COLOURS[0]), coloured(strip(walk, copies=9), COLOURS[0])
    assert len(many) == 9 * len(one)
    assert present(many[0].get_alpha()) < present(one[0].get_alpha())


def test_a_body_that_is_elsewhere_does_not_reach_into_the_next_cell(walk: tuple[Skeleton, Floats]) -> None:
    figure = strip(walk, shift=(1.0, 0.0, 0.0), ghost=True)
    figure.draw_without_rendering()
    shapes = [one for one in figure.axes[0].get_children() if isinstance(one, PathPatch | Circle) and one.get_clip_on()]
    widths = {round(box.width / figure.dpi, 3) for one in shapes if (box := one.get_clip_box()) is not None}
    assert widths == {1.2}  # inches, as a cell
    assert len(shapes) > 20


def test_bones_are_joined_to_runs_that_hold_each_bone_once() -> None:
    bones = np.array([[3, 2], [2, 1], [1, 0], [5, 4], [4, 1]])
    runs = runs_of(bones)
    drawn = [tuple(pair) for run in runs for pair in zip(run[:-1].tolist(), run[1:].tolist(), strict=True)]
    assert sorted(drawn) == sorted(map(tuple, bones.tolist()))
    assert len(runs) == 2


def test_poses_are_turned_into_their_headings_and_stay_in_the_middle() -> None:
    walk = generate_gait(1.2, 0.0, 1.0)
    pose = replace(walk, poses=walk.poses[30:31])
    row = PoseRow("", "", [pose, pose], headings_rad=np.array([0.0, np.pi]))
    figure = draw_pose_rows([row], ["a", "b"], ["", ""])
    left, right = ([points_of(one)[:, 0] for one in coloured(figure, colour)] for colour in COLOURS[:2])
    apart = [a.mean() - b.mean() for a, b in zip(left, right, strict=True)]
    assert apart[0] * apart[1] < 0  # seen from the front, then from behind
    assert abs(apart[0] + apart[1]) < 0.02
    middles = [(a.mean() + b.mean()) / 2 for a, b in zip(left, right, strict=True)]
    assert middles[1] - middles[0] == pytest.approx(POSE_CELL_IN[0], abs=0.3)


def test_ghosts_of_pose_rows_are_named_and_keep_their_distance() -> None:
    walk = generate_gait(1.2, 0.0, 1.0)
    here, there = (replace(walk, poses=walk.poses[frame : frame + 1]) for frame in (30, 33))
    figure = draw_pose_rows([PoseRow("", "", [here], ghost=[there])], ["a"], [""], ghost="revision 1")
    assert "revision 1" in {text.get_text() for text in figure.axes[0].texts}
    ghosts = np.concatenate([points_of(one) for one in coloured(figure, REFERENCE)])
    bodies = np.concatenate([points_of(one) for colour in COLOURS[:2] for one in coloured(figure, colour)])
    assert 0.01 < abs(ghosts[:, 0].mean() - bodies[:, 0].mean()) < 0.3


@pytest.mark.parametrize("name", ["Müllers sehr langer Gang über die große Brücke, Übung 12 b", "Ü" * 60, "walk " * 60])
def test_a_long_name_is_broken_into_lines_and_leaves_the_width_to_the_poses(name: str) -> None:
    clip = generate_gait(1.2, 0.0, 1.0)
    poses = [replace(clip, poses=clip.poses[frame : frame + 1]) for frame in (0, 30, 59)]
    figure = draw_pose_rows([PoseRow(name, "revision 1", poses)], ["0", "1", "2"], ["", "", ""])
    assert figure.get_size_inches()[0] < 3 * POSE_CELL_IN[0] + 3.0
    assert not cut_off(figure)
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert "revision 1" in texts
    if len(name) <= 60:
        assert name.replace(" ", "") in "".join(texts).replace(" ", "")


def test_a_motion_whose_origin_is_at_the_hips_is_as_large_as_one_on_the_floor() -> None:
    clip = generate_gait(1.2, 0.0, 1.0)
    lowered = clip.poses.copy()
    lowered[:, 1] -= 0.95
    sunk = replace(clip, poses=lowered)
    heights = []
    for one in (clip, sunk):
        poses = [one.sliced(frame, frame + 1) for frame in (0, 20, 40)]
        figure = draw_pose_rows([PoseRow("walk", "", poses, ghost=poses)], ["0", "20", "40"], [""] * 3)
        (legs, *_) = coloured(figure, COLOURS[0])
        heights.append(float(np.ptp(points_of(legs)[:, 1])))
        texts = {text.get_text() for text in figure.axes[0].texts}
        assert any("floor drawn at -" in text for text in texts) == (one is sunk)
    assert heights[1] == pytest.approx(heights[0], rel=0.1)


def test_a_prop_of_one_joint_is_drawn_as_a_dot_in_each_cell() -> None:
    prop = Skeleton(("Prop",), np.array([-1], np.int32), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    poses = [Clip(prop, 30.0, np.array([[x, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0]], np.float32)) for x in (0.0, 0.5)]
    figure = draw_pose_rows([PoseRow("prop", "", poses)], ["frame 0", "frame 1"], ["0 s", "1 s"])
    dots = [patch for patch in figure.axes[0].get_children() if isinstance(patch, Circle)]
    assert len(dots) == 2
    lefts = [dot.get_extents().x0 / figure.dpi for dot in dots]
    assert lefts[1] - lefts[0] == pytest.approx(POSE_CELL_IN[0])
    assert not cut_off(figure)

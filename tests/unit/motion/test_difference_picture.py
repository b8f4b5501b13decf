"""Pictures of differences: readable, with nothing cut off, and the same bytes for the same difference."""

import io
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray
from tests.support.drawn_figures import cut_off
from tests.support.edited_takes import make_walk

from marey_motion.clip import Clip
from marey_motion.difference.clips import compare_clips
from marey_reports.differences import picture
from marey_reports.differences.picture import draw_difference
from marey_reports.drawing import paper
from marey_schemas.documents.differences import Difference, DifferenceOptions

WALK = make_walk(turn_rate_rad_s=0.4, seconds=2.0)


def difference_of(name: str = "walk", **members: Any) -> Difference:
    sides = {side: {"item": "x", "name": name, "revision": n} for side, n in (("before", 1), ("after", 2))}
    return Difference.model_validate({"kind": "clip", "options": {}, "parts": {}, **sides, **members})


def difference_of_clips(before: Clip, after: Clip, **members: Any) -> Difference:
    motion, plot = compare_clips(before, after, DifferenceOptions(), plot=True)
    return difference_of(motion=motion, plot=plot, **members)


def arm_edited() -> Clip:
    poses = WALK.poses.copy()
    arm = slice(3 + 4 * 10, 7 + 4 * 10)
    poses[40:80, arm] = poses[20, arm]
    return replace(WALK, poses=poses)


def elsewhere() -> NDArray[np.float32]:
    """Return the frames with every joint turned upside down."""
    flipped = np.tile(np.array([0.0, 1.0, 0.0, 0.0], np.float32), (20, WALK.skeleton.joint_count))
    return np.concatenate((np.full((20, 3), 9.0, np.float32), flipped), axis=1)


def layer(*segments: tuple[str, int, int]) -> dict[str, Any]:
    named = [{"label": label, "start": start, "end": end} for label, start, end in segments]
    keyframes = [{"label": "contact", "frame": 30}]
    return {"clip": {"item": "x", "revision": 1}, "segments": named, "keyframes": keyframes}


DIFFERENCES = {
    "an edited arm": difference_of_clips(WALK, arm_edited()),
    "trimmed": difference_of_clips(WALK, arm_edited().sliced(12, 100)),
    "equal": difference_of_clips(WALK, WALK),
    "one frame": difference_of_clips(WALK.sliced(0, 1), WALK.sliced(0, 1)),
    "nothing in common": difference_of_clips(WALK.sliced(0, 20), replace(WALK.sliced(0, 20), poses=elsewhere())),
    "a name with signs": difference_of_clips(WALK, WALK.sliced(5, 90), name="$x_1$ <&>" + "long " * 20),
    "annotations": difference_of(
        annotations=(layer(("idle", 0, 80), ("walk", 80, 200)), layer(("idle", 0, 90), ("a very long label", 90, 92)))
    ),
    "empty annotations": difference_of(annotations=(layer(), layer())),
}


@pytest.mark.parametrize("difference", DIFFERENCES.values(), ids=list(DIFFERENCES))
def test_pictures_are_drawn_as_svg_with_nothing_cut_off(
    difference: Difference, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures: list[Any] = []

    def write_svg(figure: Any, title: str) -> str:
        figures.append(figure)
        return paper.to_svg(figure, title)

    monkeypatch.setattr(picture, "to_svg", write_svg)
    assert ElementTree.fromstring(draw_difference(difference, "svg")).tag.endswith("svg")
    assert cut_off(figures[0]) == []


# One of motion and one of annotations: a PNG takes long, and shows what the SVG shows.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in ("annotations", "an edited arm") else pytest.mark.soak)
        for name in DIFFERENCES
    ],
)
def test_pictures_have_the_same_bytes_each_time(name: str) -> None:
    drawn = draw_difference(DIFFERENCES[name], "png")
    assert imread(io.BytesIO(drawn)).shape[0] > 100
    assert draw_difference(DIFFERENCES[name], "png") == drawn
    assert draw_difference(DIFFERENCES[name], "svg") == draw_difference(DIFFERENCES[name], "svg")


def test_only_differences_with_values_to_draw_have_a_picture() -> None:
    with pytest.raises(ValueError, match="only differences between two motions or between two annotations"):
        draw_difference(difference_of(), "png")


def test_a_difference_without_values_to_draw_is_refused_with_the_remedy() -> None:
    without = DIFFERENCES["trimmed"].model_copy(update={"plot": None})
    with pytest.raises(ValueError, match="request it again with plot=True"):
        draw_difference(without, "svg")


def test_keyframes_and_segments_of_both_annotations_are_named() -> None:
    text = draw_difference(DIFFERENCES["annotations"], "svg").decode()
    assert all(name in text for name in ("idle", "walk", "contact", "before", "after"))

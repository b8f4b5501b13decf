"""Figures of models and alignments show the learned values, for any model."""

import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from tests.support.drawn_figures import cut_off, has_sound_data, is_sound, is_sound_svg, rows_of
from tests.support.drawn_models import DRAWN_MODELS, QUICK, figures_of, figures_of_walks, model_of_walks, trained_on
from tests.support.model_examples import FRAMES, walks
from tests.support.present import present
from tests.support.tiers import is_soak

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.modelling.search.check import SearchCheck
from marey_motion.skeleton import Skeleton
from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.models.figures import (
    ALIGNMENT_FIGURES,
    MODEL_FIGURES,
    PUBLISHED,
    ModelSubject,
    draw_alignment_figures,
    draw_search_errors,
)
from marey_reports.models.figures.components import draw_component
from marey_reports.models.figures.latent_space import ellipse
from marey_reports.models.figures.samples import reach_of
from marey_schemas.options.modelling import ModelOptions

pytestmark = DRAWN_MODELS


def modelled(aligned: AlignedSet, options: ModelOptions = QUICK) -> ModelSubject:
    return trained_on(aligned, options)[1]


def drawn_of(subject: ModelSubject, name: str) -> DrawnFigure:
    """Draw one figure of a model, without the others."""
    title, draw = MODEL_FIGURES[name]
    sketch = draw(subject)
    assert sketch is not None
    return DrawnFigure(sketch, name, PUBLISHED.get(name, ""), title)


@pytest.fixture(scope="module")
def subject() -> ModelSubject:
    return model_of_walks()[1]


@pytest.fixture(scope="module")
def figures() -> Mapping[str, DrawnFigure]:
    return figures_of_walks()


def test_every_figure_is_sound(figures: Mapping[str, DrawnFigure]) -> None:
    assert (set(ALIGNMENT_FIGURES) | set(MODEL_FIGURES) | {"component-1"}) - set(figures) == {"search-errors"}
    for figure in figures.values():
        is_sound(figure)


@pytest.mark.parametrize("name", ["samples", "durations", "latent-space", "variance"])
def test_a_figure_of_the_same_model_has_the_same_bytes(
    name: str, subject: ModelSubject, figures: Mapping[str, DrawnFigure]
) -> None:
    again = drawn_of(replace(subject), name)
    assert (again.svg, again.data) == (figures[name].svg, figures[name].data)
    if name == "samples":  # drawing a PNG takes long
        assert again.png == figures[name].png


@pytest.mark.soak
def test_all_figures_of_the_same_model_have_the_same_bytes(
    subject: ModelSubject, figures: Mapping[str, DrawnFigure]
) -> None:
    again = figures_of(replace(subject))
    assert set(again) == set(figures)
    for name, figure in again.items():
        assert figure.files() == figures[name].files(), name


@pytest.mark.soak
def test_threads_draw_the_same_figures_at_once(subject: ModelSubject, figures: Mapping[str, DrawnFigure]) -> None:
    with ThreadPoolExecutor(3) as pool:
        drawn = list(pool.map(lambda _: draw_alignment_figures(subject.examples), range(3)))
    assert {each["time-warps"].svg for each in drawn} == {figures["time-warps"].svg}


def test_matplotlib_is_not_loaded_before_something_is_drawn() -> None:
    script = "import sys, marey_reports.models.page; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


# Alignments


def test_time_warps_hold_the_time_functions_of_all_clips(
    subject: ModelSubject, figures: Mapping[str, DrawnFigure]
) -> None:
    rows = rows_of(figures["time-warps"], "time_functions")
    for clip in subject.examples.clips:
        mine = [row for row in rows if row["clip"] == clip.uid]
        assert [row["source_frame"] for row in mine] == clip.time_function.tolist()
        assert [row["canonical_frame"] for row in mine] == list(range(FRAMES))
    durations = {row["clip"]: row["duration_s"] for row in rows_of(figures["time-warps"], "clips")}
    assert durations["walk000"] == (FRAMES - 1) / 60.0


def test_the_clips_whose_timing_is_unlike_the_references_are_named(subject: ModelSubject) -> None:
    aligned = subject.examples
    late = np.concatenate((np.linspace(0.0, 5.0, FRAMES - 5), [20.0, 40.0, 60.0, 80.0, 100.0]))
    odd = replace(aligned.clips[7], name="late one", time_function=late, source_frames=101)
    figure = draw_alignment_figures(replace(aligned, clips=(*aligned.clips[:7], odd, *aligned.clips[8:])))["time-warps"]
    assert "late one" in figure.svg


def test_keyframes_are_marked_by_their_labels(figures: Mapping[str, DrawnFigure]) -> None:
    assert "left foot down" in figures["time-warps"].svg
    assert "left foot down" in figures["mean"].svg
    assert "2 keyframes" in figures["time-warps"].caption


def test_costs_show_the_worst_clip_and_a_typical_one_with_their_ways(
    subject: ModelSubject, figures: Mapping[str, DrawnFigure]
) -> None:
    rows = rows_of(figures["alignment-costs"], "paths")
    assert list(dict.fromkeys(row["clip"] for row in rows)) == ["walk006", "walk011"]
    worst = [row["clip_frame"] for row in rows if row["clip"] == "walk011"]
    assert worst == subject.examples.clips[11].time_function.tolist()


def test_a_clip_that_is_the_reference_played_at_half_speed_costs_nothing_along_its_way(subject: ModelSubject) -> None:
    aligned = subject.examples
    first, other = aligned.clips[:2]
    slow = replace(
        other,
        motion=first.motion,
        time_function=2.0 * np.arange(FRAMES, dtype=np.float64),
        source_frames=2 * FRAMES - 1,
    )
    rows = rows_of(draw_alignment_figures(replace(aligned, clips=(first, slow)))["alignment-costs"], "paths")
    assert max(row["distance_cm"] for row in rows) < 1e-6


# Components


def test_a_sweep_goes_two_deviations_to_both_sides_of_the_mean(
    subject: ModelSubject, figures: Mapping[str, DrawnFigure]
) -> None:
    primitive = subject.primitive
    rows = rows_of(figures["component-1"], "positions")
    latents = np.zeros((1, primitive.dimensions))
    latents[0, 0] = 2.0 * np.sqrt(primitive.spatial.variances[0])
    last = subject.points(primitive.poses(latents)[0, -1])
    drawn = [row for row in rows if row["row"] == "+2 sd" and row["canonical_frame"] == FRAMES - 1]

    assert list(dict.fromkeys(row["row"] for row in rows)) == ["−2 sd", "−1 sd", "mean", "+1 sd", "+2 sd"]
    assert [row["joint"] for row in drawn] == list(primitive.skeleton.joint_names)
    places = np.array([[row["x_m"], row["y_m"], row["z_m"]] for row in drawn])
    assert np.allclose(places, last[: len(places)], atol=1e-12)


def test_the_caption_of_a_component_tells_its_share_and_what_it_moves(subject: ModelSubject) -> None:
    caption = draw_component(subject, 0).caption
    assert f"({100 * subject.primitive.spatial.energy[0]:.0f} % of the variance)" in caption
    assert any(joint in caption for joint in subject.primitive.skeleton.joint_names)


def test_time_components_hold_the_durations_of_the_model(
    subject: ModelSubject, figures: Mapping[str, DrawnFigure]
) -> None:
    primitive = subject.primitive
    rows = rows_of(figures["time-components"], "time")
    means = {row["time_s"] for row in rows if row["deviations"] == 0.0 and row["canonical_frame"] == FRAMES - 1}
    assert list(means) == pytest.approx([float(primitive.durations_s(np.zeros((1, primitive.dimensions)))[0])])


def test_names_of_keyframes_do_not_lie_over_curves(subject: ModelSubject) -> None:
    for drawn in (drawn_of(subject, "time-components"), draw_alignment_figures(subject.examples)["time-warps"]):
        figure = drawn.sketch.figure
        names = [text for axes in figure.axes for text in axes.texts if "foot down" in text.get_text()]
        assert len(names) == 2
        for name in names:
            panel = present(name.axes)
            box = name.get_window_extent()
            for line in panel.lines:
                points = np.asarray(line.get_xydata())
                if len(points) > 2:  # a curve, not the line of a keyframe
                    places = panel.transData.transform(points)
                    assert np.interp([box.x0, box.x1], *places.T).max() < box.y0


def test_the_number_of_kept_components_is_beside_its_line(subject: ModelSubject) -> None:
    panel = drawn_of(subject, "reconstruction").sketch.figure.axes[0]
    (name,) = (text for text in panel.texts if "kept" in text.get_text())
    kept = subject.primitive.spatial.count
    assert name.get_text() == f"kept: {kept}"
    line = panel.transData.transform((kept, 0.0))[0]
    assert name.get_window_extent().x0 > line + 2.0


def test_columns_of_strips_are_keyframes_where_there_are_some(subject: ModelSubject) -> None:
    frames, moments = subject.moments()
    assert frames.tolist() == sorted(frames.tolist())
    assert dict(zip(moments.labels, frames.tolist(), strict=True)).items() >= subject.primitive.keyframes.items()
    assert (frames[0], frames[-1]) == (0, FRAMES - 1)


def test_motions_that_travel_are_seen_more_from_the_side(subject: ModelSubject) -> None:
    place = np.tile((0.0, 1.0, 0.0), (FRAMES, 1))
    clips = [replace(clip, motion=clip.motion._replace(root_translations=place)) for clip in subject.examples.clips]
    standing = modelled(replace(subject.examples, clips=tuple(clips)))
    assert abs(standing.seen_from_rad) < abs(subject.seen_from_rad)


# Examples and samples


def test_examples_stand_beside_as_many_samples(subject: ModelSubject, figures: Mapping[str, DrawnFigure]) -> None:
    rows = rows_of(figures["samples"], "positions")
    names = list(dict.fromkeys(row["row"] for row in rows))
    uids = [clip.uid for clip in subject.examples.clips]
    assert names == [*uids, *(f"sample {number}" for number in range(16))]
    pelvis = subject.primitive.skeleton.joint_names[0]
    first = next(row for row in rows if row["row"] == uids[3] and row["joint"] == pelvis)
    assert [first["x_m"], first["y_m"], first["z_m"]] == pytest.approx(subject.examples.poses[3, 0, :3].tolist())


def test_paths_are_those_of_wrists_and_ankles(subject: ModelSubject, figures: Mapping[str, DrawnFigure]) -> None:
    rows = rows_of(figures["paths"], "paths")
    assert {row["joint"] for row in rows} == {"left wrist", "right wrist", "left ankle", "right ankle"}
    assert len({row["motion"] for row in rows}) == 2 * len(subject.examples.clips)


def test_the_reach_of_examples_is_where_their_joints_are(subject: ModelSubject) -> None:
    reaches = {reach.joint: reach for reach in reach_of(subject)}
    assert reaches["left wrist"].examples_m[0, 0] > reaches["right wrist"].examples_m[0, 1] - 0.4
    for reach in reaches.values():
        assert (reach.examples_m[:, 0] <= reach.examples_m[:, 1]).all()
        assert np.abs(reach.samples_m - reach.examples_m).max() < 0.5


def test_durations_are_shares_of_all_motions(figures: Mapping[str, DrawnFigure]) -> None:
    rows = rows_of(figures["durations"], "durations")
    assert sum(row["examples_share"] for row in rows) == pytest.approx(1.0)
    assert sum(row["samples_share"] for row in rows) == pytest.approx(1.0)


# Numbers


def test_variance_reconstruction_and_mixture_are_those_of_the_training_report(
    subject: ModelSubject, figures: Mapping[str, DrawnFigure]
) -> None:
    report = subject.report
    assert [row["share"] for row in rows_of(figures["variance"], "poses")] == report.spatial_energy.tolist()
    kept = sum(row["kept"] for row in rows_of(figures["variance"], "time"))
    assert kept == subject.primitive.temporal.count
    errors = rows_of(figures["reconstruction"], "errors")
    assert [row["left_out_cm"] for row in errors] == present(present(report.reconstruction).left_out_cm).tolist()
    assert [row["training_cm"] for row in errors] == present(report.reconstruction).training_cm.tolist()
    assert [row["bic"] for row in rows_of(figures["mixture"], "candidates")] == [c.bic for c in report.candidates]


def test_the_latent_space_holds_examples_and_samples(subject: ModelSubject, figures: Mapping[str, DrawnFigure]) -> None:
    rows = rows_of(figures["latent-space"], "examples")
    assert [row["example"] for row in rows] == [clip.uid for clip in subject.examples.clips]
    assert [row["poses 1"] for row in rows] == pytest.approx(subject.latents[:, 0].tolist())
    assert len(rows_of(figures["latent-space"], "samples")) == 400


def test_an_outline_holds_two_standard_deviations() -> None:
    covariance = np.array([[2.0, 0.6], [0.6, 1.0]])
    away = ellipse(np.array([1.0, -1.0]), covariance) - (1.0, -1.0)
    assert np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away) == pytest.approx(np.full(60, 4.0))


def test_examples_stand_in_the_order_of_their_likelihood_and_odd_ones_are_named(subject: ModelSubject) -> None:
    examples = list(subject.report.examples)
    examples[4] = replace(examples[4], held_out_log_likelihood=-1e4, outlier=True, name="limping")
    clips = list(subject.examples.clips)
    clips[4] = replace(clips[4], name="limping")
    odd = replace(
        subject,
        report=replace(subject.report, examples=tuple(examples)),
        examples=replace(subject.examples, clips=tuple(clips)),
    )
    figure = drawn_of(odd, "likelihood")
    rows = rows_of(figure, "examples")

    assert rows[0]["example"] == clips[4].uid
    assert [row["held_out_log_likelihood"] for row in rows] == sorted(row["held_out_log_likelihood"] for row in rows)
    assert "limping" in figure.caption


def test_search_errors_are_drawn_beside_each_other() -> None:
    searched, refined = np.array([3.0, 5.0, 40.0]), np.array([0.1, 0.2, 12.0])
    sketch = draw_search_errors(searched, refined, about="wrists of examples left out")
    assert sketch.tables["errors"]["refined_cm"] is refined
    assert "5.0 cm (worst 40.0 cm)" in sketch.caption
    assert "0.2 cm (worst 12.0 cm)" in sketch.caption
    assert "wrists of examples left out" in sketch.caption
    assert not cut_off(sketch.figure)


# Odd models


def headless(aligned: AlignedSet) -> AlignedSet:
    """Return the same motions on a skeleton whose joint names are unknown."""
    old = aligned.skeleton
    names = tuple(f"j{number}" for number in range(old.joint_count))
    bare = Skeleton(names, old.parents, old.offsets, old.rest_rotations)
    return replace(aligned, skeleton=bare)


def alike(aligned: AlignedSet, count: int) -> AlignedSet:
    first = aligned.clips[0]
    copies = tuple(replace(first, uid=f"copy{index}", name=f"copy {index}") for index in range(count))
    return replace(aligned, clips=copies, reference="copy0")


def backwards(aligned: AlignedSet) -> AlignedSet:
    """Return motions that stay below the floor and move backwards."""
    clips = []
    for clip in aligned.clips:
        moved = clip.motion.root_translations * (1.0, 1.0, -3.0) - (0.0, 2.5, 0.0)
        clips.append(replace(clip, motion=clip.motion._replace(root_translations=moved)))
    return replace(aligned, clips=tuple(clips))


LONG_NAMES = ("lab/" + "w" * 300, "lab/$x^2_{", "lab/<b>", "lab/\x00\n", "", "日本")
MANY_KEYFRAMES = {f"a long keyframe label {number}": number for number in range(FRAMES)}

ODD = {
    "no components": lambda: modelled(alike(walks(3), 3)),
    "one example": lambda: modelled(alike(walks(2), 1)),
    "two examples": lambda: modelled(walks(2)),
    "several kinds": lambda: modelled(walks(40), QUICK.replace(mixture_components=3, spatial_components=2)),
    "one pose component": lambda: modelled(walks(6), QUICK.replace(spatial_components=1, most_temporal_components=0)),
    "only time": lambda: modelled(walks(6), QUICK.replace(spatial_components=0)),
    "nothing held out": lambda: modelled(walks(6), QUICK.replace(folds=0, leave_one_out=False, report_samples=0)),
    "long names": lambda: modelled(walks(6, names=LONG_NAMES)),
    "no known joints": lambda: modelled(headless(walks(6))),
    "few frames": lambda: modelled(walks(5, frames=6)),
    "many keyframes": lambda: modelled(replace(walks(6), keyframes=MANY_KEYFRAMES)),
    "below the floor": lambda: modelled(backwards(walks(6))),
}  # fmt: skip
NUMBERS = ("variance", "reconstruction", "mixture", "likelihood")
STRIPS = ("mean", "samples", "component-1")
ODD_SHOWS = {
    "no components": ("samples", "paths", "time-components", "latent-space", "alignment-costs", *NUMBERS),
    "one example": ("samples", "durations", "time-warps", "alignment-costs", "latent-space", *NUMBERS),
    "two examples": ("component-1", "time-components", "latent-space", "time-warps", *NUMBERS),
    "several kinds": ("mixture", "latent-space", "likelihood"),
    "one pose component": ("component-1", "time-components", "latent-space", "variance"),
    "only time": ("mean", "time-components", "latent-space", "variance"),
    "nothing held out": ("samples", "durations", "latent-space", *NUMBERS),
    "long names": ("samples", "paths", "latent-space", "likelihood", "time-warps", "alignment-costs"),
    "no known joints": ("paths", "time-components", *STRIPS),
    "few frames": ("time-components", "time-warps", "alignment-costs", *STRIPS),
    "many keyframes": ("time-components", "time-warps", "alignment-costs", *STRIPS),
    "below the floor": ("paths", *STRIPS),
}
"""Names of the figures that show the unusual property of each model in `ODD`."""


@pytest.mark.every_nth(6)
@pytest.mark.parametrize("odd", ODD)
def test_odd_models_are_drawn_and_nothing_is_cut_off(odd: str) -> None:
    subject = ODD[odd]()
    wanted = {*MODEL_FIGURES, *ALIGNMENT_FIGURES, "component-1"}
    wanted = wanted if is_soak() else wanted.intersection(ODD_SHOWS[odd])
    sketches = {name: draw(subject) for name, (_, draw) in MODEL_FIGURES.items() if name in wanted}
    sketches |= {name: draw(subject.examples) for name, (_, draw) in ALIGNMENT_FIGURES.items() if name in wanted}
    if subject.primitive.spatial.count and "component-1" in wanted:
        sketches["component-1"] = draw_component(subject, 0)
    for name, sketch in sketches.items():
        if sketch is not None:
            assert cut_off(sketch.figure) == [], name
            figure = has_sound_data(DrawnFigure(sketch, name, "", name))
            if odd == "long names" or is_soak():
                assert "<b>" not in (is_sound(figure) if is_soak() else is_sound_svg(figure)).svg


def many(count: int) -> AlignedSet:
    """Return `count` walks, most of them copies of 20 generated walks, because generating takes long."""
    aligned = walks(20)
    clips = []
    for number in range(count):
        clip = aligned.clips[number % 20]
        moved = clip.motion.root_translations + np.array((0.0, 1e-4 * number, 0.0))
        motion = clip.motion._replace(root_translations=moved)
        clips.append(replace(clip, uid=f"walk{number:03d}", name=f"walk {number:03d}", motion=motion))
    return replace(aligned, clips=tuple(clips))


@pytest.mark.soak
def test_two_hundred_examples_are_drawn_as_twenty_are() -> None:
    subject = modelled(many(200), QUICK.replace(leave_one_out=False, folds=0))
    drawn = figures_of(subject)
    assert len(rows_of(drawn["likelihood"], "examples")) == 200
    assert "170 likeliest are not shown" in drawn["likelihood"].caption
    for figure in drawn.values():
        is_sound(figure) if is_soak() else is_sound_svg(figure)
        assert len(figure.svg) < 700_000


def test_the_figures_of_no_samples_of_the_search_say_so() -> None:
    assert draw_search_errors(np.zeros(0), np.zeros(0)).caption == "No target was searched for."


def test_the_check_of_searches_is_drawn_where_there_is_one(subject: ModelSubject) -> None:
    found = SearchCheck(
        ("take", "subject"),
        ("walk001", "walk001"),
        ("left_wrist", "right_wrist"),
        (5, 9),
        np.array([2.0, 3.0]),
        np.ones(2),
    )
    figure = drawn_of(replace(subject, check=found), "search-errors")
    assert [row["joint"] for row in rows_of(figure, "errors")] == ["left_wrist", "right_wrist"]
    assert "hands and feet of 1 example, for models trained without" in figure.caption
    assert "1.00 cm for unseen performers" in figure.caption

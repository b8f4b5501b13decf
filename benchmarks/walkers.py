"""The analysis of Pražák et al. (2009) with 21 walks of the real collection and simulated participants.

`MAREY_TEST_MOCAP=FOLDER python -m benchmarks.walkers` writes the figures of the page
`docs/explanation/twenty-one-walkers.md` and prints the numbers of the page.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from benchmarks.material import real_folder
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.formats import read_motion
from marey_motion.matching.body import MatchingBody
from marey_motion.perception.comparing import ClipDistances, ComparableClip, compare_pairs, prepare_comparison
from marey_motion.perception.judging import difference_table, simulate_judgements
from marey_motion.perception.metric import PerceptualMetric, metric_of, published_metric
from marey_motion.perception.registration import registration_curve
from marey_motion.perception.study_analysis import StudyAnalysis, analyse_study, measure_pairs
from marey_motion.retargeting import plan_retarget, retarget
from marey_motion.rigs import guess_axes, map_joints
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import COLOURS, QUIET, Place, add_keys, add_panel, new_figure, to_png, write
from marey_reports.perception.motion_maps import NamedClip, draw_components, draw_registration
from marey_reports.perception.study_page import draw_groups, draw_table
from marey_schemas.documents.metrics import built_in_metric

FOLDER = Path(__file__).parents[1] / "docs" / "explanation" / "walkers"
RATE_HZ = 60.0
PARTICIPANTS, DRAWS, NOISE = 29, 200, 0.05
"""Participants of the paper; draws of participants for intervals; scale of the choices' noise (no unit)."""
_CMU = ("02_01", "05_01", "07_01-walk", "16_15", "49_01")
_BANDAI_1 = ("active", "angry", "feminine", "happy", "masculinity", "normal", "proud", "tired")
_BANDAI_2 = (
    "masculine_001", "masculine_005", "masculine_007", "feminine_001", "feminine_005", "feminine_007", "normal_001",
)  # fmt: skip
WALKS = (
    *(f"cmu-amc/{take[:2]}/{take}.amc" for take in _CMU),
    "cmu-bvh/cmu_12_01_walk.bvh",
    *(f"bandai-namco-1/dataset-1_walk_{style}_001.bvh" for style in _BANDAI_1),
    *(f"bandai-namco-2/dataset-2_walk_{take}.bvh" for take in _BANDAI_2),
)
PAIR = (2, 3)
"""Walks in the figures of one pair."""


def name_of(file: str) -> str:
    """Return a short name, as in `cmu 07`, `b1 proud 1`: collection, subject or style, number of the take."""
    if file.startswith("cmu"):
        return "cmu " + file.rpartition("/")[2].removeprefix("cmu_")[:2]
    collection, take = re.findall(r"dataset-(\d)_walk_(\w+)\.bvh", file)[0]
    style, _, number = take.partition("_")
    return f"b{collection} {style}" + (f" {int(number)}" if number else "")


def read_walk(folder: Path, file: str) -> Clip:
    """Read a walk, and the skeleton file beside it if the format needs one."""
    path = folder / file
    skeleton = next(path.parent.glob("*.asf"), None) if path.suffix == ".amc" else None
    companion = None if skeleton is None else skeleton.read_bytes()
    clip = read_motion(path.read_bytes(), path.name, companion=companion).clip
    assert clip is not None, "every walk has motion"
    return clip


def on_one_figure(clips: Sequence[Clip]) -> tuple[list[Clip], MatchingBody]:
    """Retarget all clips to the skeleton of the first, as the paper shows all walks on one figure."""
    target = clips[0].skeleton
    mapping = map_joints(target)
    moved = []
    for clip in clips:
        own = map_joints(clip.skeleton)
        plan = plan_retarget(
            clip.skeleton, own, guess_axes(clip.skeleton, own), target, mapping, guess_axes(target, mapping)
        )
        moved.append(retarget(clip, plan))
    return moved, MatchingBody.from_mapping(target, mapping)


def jump_at_seam(walk: ComparableClip) -> float:
    """Return how far joints move over the seam of a loop, divided by the mean of the frames before and after.

    It is 1 if the loop goes on over its seam as evenly as elsewhere.
    """
    positions = walk.compared.positions
    steps = np.linalg.norm(np.roll(positions, -1, axis=0) - positions, axis=2).mean(axis=1)
    return float(steps[-1] / (0.5 * (steps[-2] + steps[0])))


def draw_loops(walks: Sequence[ComparableClip]) -> Sketch:
    """Draw the height and the forward position of the first joint of the last class, a toe, over two rounds of each
    loop: a jump would show at the middle line.
    """
    columns = 7
    rows = -(-len(walks) // columns)
    figure = new_figure(9.6, 0.45 + 1.2 * rows)
    for number, walk in enumerate(walks):
        row, column = divmod(number, columns)
        place = Place(0.25 + column * 1.32, 0.45 + (rows - 1 - row) * 1.2, 1.15, 0.85)
        panel = add_panel(figure, place, grid=False)
        place_m = walk.compared.positions[:, -1]
        rounds = np.arange(2 * len(place_m)) / len(place_m)
        panel.plot(rounds, np.tile(place_m[:, 2], 2), color=COLOURS[0], lw=1.2, label="forward")
        panel.plot(rounds, np.tile(place_m[:, 1], 2), color=COLOURS[1], lw=1.2, label="up")
        panel.axvline(1.0, color=QUIET, lw=0.6)
        panel.set(xticks=[0, 1, 2], yticks=[], ylim=(-0.6, 1.1))
        write(panel, (0.0, 1.08), walk.name, transform=panel.transAxes)
        if number == len(walks) - 1:
            add_keys(panel, loc="upper right", bbox_to_anchor=(1.0, -0.2), ncols=2)
    jumps = {"walk": [one.name for one in walks], "jump_at_seam": [jump_at_seam(one) for one in walks]}
    return Sketch(figure, {"seams": jumps}, "The right toe over two rounds of each loop.")


def distances_of(walks: Sequence[ComparableClip], metric: PerceptualMetric) -> Floats:
    """Compute the distances (n, n) of all pairs of loops."""
    pairs = np.array(list(combinations(range(len(walks)), 2)))
    compared = {number: walk.compared for number, walk in enumerate(walks)}
    found = compare_pairs(compared, pairs, metric, threads=1, progress=lambda *_: None)
    return np.asarray(ClipDistances.of(len(walks), pairs, found).totals)


def analysed(walks: Sequence[ComparableClip], truth: Floats) -> StudyAnalysis:
    """Simulate a study of the paper's size, in which people see the differences `truth`, and analyse it."""
    judgements = simulate_judgements(truth, PARTICIPANTS, seed=1, noise=NOISE)
    pairs = measure_pairs([walk.compared for walk in walks], lambda *_: None)
    return analyse_study(judgements, pairs, name="walkers", draws=DRAWS, seed=1)


def main() -> None:
    """Write all figures, and print the numbers."""
    folder = real_folder()
    if folder is None:
        raise SystemExit("MAREY_TEST_MOCAP must name the folder of real motion capture")
    metric = published_metric("sigmoid")
    clips, body = on_one_figure([read_walk(folder, file) for file in WALKS])
    names = [name_of(file) for file in WALKS]
    walks = [
        prepare_comparison(clip, body, metric, RATE_HZ, name=name) for clip, name in zip(clips, names, strict=True)
    ]
    one, other = (NamedClip(walks[number].name, walks[number].compared) for number in PAIR)
    recorded = NamedClip(one.name, walks[PAIR[0]].recorded)
    curve = registration_curve(one.clip, other.clip, metric)
    truth = distances_of(walks, metric_of(built_in_metric("published/positions-sigmoid")))
    analysis = analysed(walks, truth)
    assert analysis.order is not None
    sketches = {
        "loops": draw_loops(walks),
        "figure-1": draw_registration(one, other, metric, walks[PAIR[0]].period, curve, recorded=recorded),
        "figure-3": draw_groups(analysis.order, names),
        "figure-4": draw_table(analysis, names),
        "figure-6": draw_components(one, other, metric),
    }
    FOLDER.mkdir(exist_ok=True)
    for name, sketch in sketches.items():
        (FOLDER / f"{name}.png").write_bytes(to_png(sketch.figure))
    _print_numbers(walks, truth, analysis)


def _print_numbers(walks: Sequence[ComparableClip], truth: Floats, analysis: StudyAnalysis) -> None:
    periods = [walk.period.frames / RATE_HZ for walk in walks if walk.period is not None]
    jumps = [jump_at_seam(walk) for walk in walks]
    print(
        f"periods {min(periods):.2f} to {max(periods):.2f} s; step at the seam over other steps "
        f"{min(jumps):.2f} to {max(jumps):.2f}"
    )
    for walk, jump in zip(walks, jumps, strict=True):
        print(f"  {walk.name:18} {walk.period.frames / RATE_HZ if walk.period else 0:.2f} s  {jump:.2f}")
    table = difference_table(analysis.judgements)
    upper = np.triu_indices(len(walks), 1)
    shown = table.shown[upper]
    print(
        f"trials {len(analysis.judgements.chosen)}, showings of a pair {shown.min()} to {shown.max()}, mean "
        f"{shown.mean():.1f}; chosen {analysis.chosen_share:.6f}; noise ceiling {table.noise_ceiling}"
    )
    print(
        f"true distances {truth[upper].min():.2f} to {truth[upper].max():.2f}; Spearman of table and truth "
        f"{spearmanr(table.differences[upper], truth[upper]).statistic:.3f}"
    )
    kept = 100 * (1 - analysis.violated / analysis.checked)
    print(f"triangle inequalities {kept:.1f} % of {analysis.checked}")
    order = analysis.order
    if order is not None:
        print(
            "groups", *([walks[each].name for each in order.order if order.groups[each] == group] for group in (0, 1))
        )
    for fit in analysis.fits:
        print(f"{fit.parts[0].component.shaping}, shares {fit.metric.shares}: rmse {fit.quality.rmse:.4f}")
        for part in fit.parts:
            one = part.component
            weights = " ".join(f"{name} {share:.3f}" for name, share in one.weights.items())
            print(
                f"  {one.measurement:10} rmse {part.quality.rmse:.4f} exponent {one.exponent:.2f} c {one.constant:.3f} "
                f"N {one.norm:.3f} {weights}"
            )


if __name__ == "__main__":
    main()

"""A page of every kind of report, for tests that open them in a browser or look for what every page must have.

Run `python -m tests.support.every_report FOLDER` to look at the pages.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from math import radians
from pathlib import Path
from types import MappingProxyType

from tests.support.compared_evaluations import compare_results
from tests.support.compared_runs import a_curve, a_run, compared_of
from tests.support.drawn_models import figures_of_walks, model_of_walks
from tests.support.project_in_memory import ProjectInMemory, add_clip
from tests.support.real_takes import body_of, read_takes
from tests.support.studying import analysis_of
from tests.support.tiers import MOCAP_VARIABLE

from marey_motion.evaluation.compare import compare_several
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.suite import evaluate
from marey_motion.gait import generate_gait
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.perception.comparing import compare_clips, prepare_comparison
from marey_motion.perception.metric import metric_of
from marey_reports.comparisons.page import draw_comparison
from marey_reports.drawing.head import ReportInput
from marey_reports.evaluation.page import render_comparison, render_report
from marey_reports.evaluation.several import render_several
from marey_reports.models.page import render_model_report
from marey_reports.perception.compared import ComparedClip, ComparedSet
from marey_reports.perception.page import draw_distance_figures, render_distances
from marey_reports.perception.study_page import render_study_report
from marey_schemas.documents.metrics import built_in_metric
from marey_schemas.documents.report_pages import ReportOrigin, with_origin
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.perception import DistanceOptions
from marey_schemas.queue.job_params import QualityParams
from marey_worker.kinds import quality
from marey_worker.kinds.evaluate import play_trials, pose_trials

OPTIONS = EvaluationOptions(
    speeds_m_s=(1.0, 1.75, 2.5), turn_rates_deg_s=(-75.0, 0.0, 75.0), duration_s=12.0, replicates=3
)
ORIGIN = ReportOrigin("lab", "https://marey.example", "rita", datetime(2026, 11, 29, 14, 5, tzinfo=UTC))
LONG_NAME = "walks/subject 07/with_a_name_that_is_much_too_long_for_a_phone_and_has_no_space_at_all_1234567890"


def inputs_of(takes: Sequence[SourceClip]) -> tuple[ReportInput, ...]:
    """Return the head's inputs: all takes, one of which has a long name, and their skeleton."""
    return (*(ReportInput("clip", one.name, 1) for one in takes), ReportInput("skeleton", LONG_NAME, 2))


@cache
def real_sets() -> tuple[tuple[SourceClip, ...], ...]:
    """Return three sets of real walks and runs of one skeleton each; generated ones without real motion capture."""
    if MOCAP_VARIABLE not in os.environ:
        cells = [(speed, turn) for speed in (1.0, 1.5, 2.0) for turn in (-75.0, 0.0, 75.0)]
        gaits = [SourceClip(f"gait{n}@1", f"gait {n}", generate_gait(speed, radians(turn), 6.0))
                 for n, (speed, turn) in enumerate(cells)]  # fmt: skip
        return tuple(gaits), tuple(gaits[:5]), tuple(gaits[4:])
    takes = read_takes(Path(os.environ[MOCAP_VARIABLE]), "cmu-amc/07/*")
    return tuple(takes), tuple(takes[:4]), tuple(takes[4:])


@cache
def evaluated(number: int) -> tuple[MatchingDatabase, EvaluationResult]:
    """Return the database and the evaluation of one of the sets, all under the normaliser of the first."""
    takes = real_sets()[number]
    normaliser = None if number == 0 else evaluated(0)[0].normaliser
    database = build_database(takes, body_of(takes[0].clip), OPTIONS.database, normaliser=normaliser)
    return database, evaluate(database, OPTIONS, threads=1, with_baseline=False)


@cache
def evaluation_page() -> str:
    """Render the report of an evaluation of real walks, with the motion of two trials and poses of each region."""
    database, result = evaluated(0)
    return render_report(
        result,
        title="Walks of subject 07",
        inputs=inputs_of(real_sets()[0]),
        played=play_trials(database, result),
        posed=pose_trials(database, result),
    )


def _two() -> str:
    before, after = evaluated(0)[1], evaluated(1)[1]
    found = compare_results(before, after)
    inputs = [ReportInput("evaluation", name, 1) for name in ("evaluations/before", LONG_NAME)]
    return render_comparison(before, after, title="Before and after", comparison=found, inputs=inputs)


def _several() -> str:
    results = [evaluated(number)[1] for number in range(3)]
    found = compare_several(results[0], results[1:])
    return render_several(results, found, title="Three sets", labels=["all", "first half", LONG_NAME])


def _model() -> str:
    trained, subject = model_of_walks()
    return render_model_report(trained, subject, figures_of_walks(), title="Walk", origin={})


def _distances() -> str:
    document = built_in_metric("published/positions-sigmoid")
    metric = metric_of(document)
    takes = real_sets()[1]
    clips = [
        prepare_comparison(one.clip, body_of(one.clip), metric, document.frame_rate_hz, name=one.name) for one in takes
    ]
    distances = compare_clips([clip.compared for clip in clips], metric)
    facts = [ComparedClip.of(clip) for clip in clips]
    subject = ComparedSet(document, facts, dict(enumerate(clips)), distances, DistanceOptions())
    inputs = inputs_of(takes)
    return render_distances(subject, draw_distance_figures(subject), title="Four walks", inputs=inputs)


def _study() -> str:
    return render_study_report(analysis_of(8), [f"motion {n}" for n in range(7)] + [LONG_NAME], title="Which walks?")


_SKELETON = "skeleton_of_reports"
"""Id of the skeleton of all clips: processes keep skeletons by id, and other tests use other skeletons."""


def _quality(folder: Path) -> str:
    project = ProjectInMemory(folder)
    for take in real_sets()[1]:
        add_clip(project, take.name, take.clip, _SKELETON)
    project.inputs["reference"] = project.inputs.pop("clips")
    for take in real_sets()[2]:
        add_clip(
            project, f"{take.name} again", replace(take.clip, frame_rate_hz=0.8 * take.clip.frame_rate_hz), _SKELETON
        )
    result = quality.run(project, QualityParams(draws=50))
    return project.blobs[result["report"]["blob"]].decode()


def _runs() -> str:
    values = {(rate, seed): 0.4 + rate + 0.03 * seed for rate in (0.001, 0.01, 0.1, 0.5) for seed in range(3)}
    runs = [a_run(n, {"rate": rate}, {"loss": loss, LONG_NAME: n}, seed=seed)
            for n, ((rate, seed), loss) in enumerate(values.items())]  # fmt: skip
    curves = {n: {"loss": a_curve([3.0, 2.0, 1.0, loss], 10)} for n, loss in enumerate(values.values())}
    return draw_comparison(compared_of(runs, curves, goals={"loss": "lowest"}), "html").decode()


REPORTS: dict[str, Callable[[Path], str]] = {
    "evaluation": lambda _folder: evaluation_page(),
    "comparison": lambda _folder: _two(),
    "several": lambda _folder: _several(),
    "model": lambda _folder: _model(),
    "distances": lambda _folder: _distances(),
    "study": lambda _folder: _study(),
    "quality": _quality,
    "runs": lambda _folder: _runs(),
}
"""Functions that render a report of each kind; the argument is a folder for temporary files."""


def write_reports(folder: Path, kinds: Iterable[str] = tuple(REPORTS)) -> Mapping[str, Path]:
    """Write a report of each of these kinds, with its origin; return the paths by kind."""
    paths = {}
    for kind in kinds:
        paths[kind] = folder / f"{kind}.html"
        paths[kind].write_bytes(with_origin(REPORTS[kind](folder).encode(), ORIGIN))
    return MappingProxyType(paths)


if __name__ == "__main__":
    Path(sys.argv[1]).mkdir(parents=True, exist_ok=True)
    for written in write_reports(Path(sys.argv[1])).values():
        print(written, written.stat().st_size)

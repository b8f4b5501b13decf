"""The function of the job kind `quality`, its report and its table, with a project in memory."""

import csv
import io
from dataclasses import replace
from math import radians
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from tests.support.project_in_memory import ProjectInMemory, add_clip

from marey_client.cli.terminal.schema_options import OptionsOf
from marey_client.errors import NotComparable
from marey_client.handles.findings import Quality
from marey_motion.clip import Clip
from marey_motion.gait import generate_gait
from marey_schemas.documents.quality import (
    MEASURES,
    QUALITY_FACETS,
    QualityConditions,
    QualityDocument,
    command_with,
    differing_conditions,
)
from marey_schemas.encoding.codecs import JSON, decode_tree
from marey_schemas.kinds import Kind
from marey_schemas.options.quality import QualityOptions
from marey_schemas.queue.facets import MOST_FACETS
from marey_schemas.queue.job_params import QualityParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import JobRefused
from marey_worker.job_io.stored_reports import inputs_of
from marey_worker.kinds import quality


def gliding(clip: Clip) -> Clip:
    poses = clip.poses.copy()
    poses[:, [0, 2]] *= 1.3
    return replace(clip, poses=poses)


def slowed(clip: Clip) -> Clip:
    return replace(clip, frame_rate_hz=20.0)


@pytest.fixture
def project(tmp_path: Path) -> ProjectInMemory:
    """A project with four gliding walks, a clip of too low a rate, and four natural walks as the reference."""
    made = ProjectInMemory(tmp_path)
    walks = [generate_gait(speed, radians(turn), 4.0) for speed, turn in ((1.2, -40), (1.2, 0), (1.5, 0), (1.5, 40))]
    for number, walk in enumerate(walks):
        add_clip(made, f"walk {number}", walk)
    reference = made.inputs.pop("clips")
    for number, walk in enumerate(walks):
        add_clip(made, f"<gliding> {number}", gliding(walk))
        made.parts[f"clip_<gliding> {number}", 1, "info"] = {"subject": "S1", "take": f"take {min(number, 2)}"}
    add_clip(made, "slow", slowed(walks[0]))
    made.inputs["reference"] = reference
    return made


def document_of(project: ProjectInMemory, result: dict[str, Any]) -> QualityDocument:
    return QualityDocument.model_validate(decode_tree(project.blobs[result["document"]["blob"]], JSON))


def test_clips_are_measured_beside_a_reference(project: ProjectInMemory) -> None:
    result = quality.run(project, QualityParams(draws=200))
    document = document_of(project, result)
    assert (result["clips"], result["reference_clips"]) == (4, 4)
    assert result["worst"]["name"].startswith("walks/<gliding>")
    assert [one["code"] for one in result["refused"]] == ["frame-rate-too-low"]
    assert document.reference is not None
    for name in ("skate_weighted_m_s", "skate_contact_m_s", "skate_ratio"):
        total, other, change = document.measured.totals[name], document.reference.totals[name], document.changes[name]
        assert total.value is not None
        assert other.value is not None
        assert change.low is not None
        assert total.value - other.value == pytest.approx(change.value)
        assert change.low > 0.0, name
    assert (document.measured.totals["jitter_m_s3"].takes, document.measured.totals["jitter_m_s3"].clips) == (3, 4)
    assert len(project.told) > 9, "every clip is progress"

    facets = {one.item: one for one in project.facets}
    assert len(facets) == 8, "the reference is measured, too"
    assert facets["clip_walk 1"].values.keys() == QUALITY_FACETS.keys()
    assert len(QUALITY_FACETS) <= MOST_FACETS
    assert (
        facets["clip_<gliding> 1"].values["skate_weighted_m_s"]
        == document.measured.clips[1].values["skate_weighted_m_s"]
    )

    page = project.blobs[result["report"]["blob"]].decode()
    assert "The reference has" in page
    assert "which is less." in page
    assert "could not be measured" in page
    assert "walks/&lt;gliding&gt;" in page
    assert "<gliding>" not in page
    for measure in MEASURES.values():
        assert measure.title in page
    rows = list(csv.DictReader(io.StringIO(project.blobs[result["table"]["blob"]].decode())))
    assert [row["role"] for row in rows] == ["clip"] * 4 + ["reference"] * 4
    assert float(rows[0]["skate_weighted_m_s"]) == document.measured.clips[0].values["skate_weighted_m_s"]
    assert {figure["name"] for figure in result["figures"]} == {"clips", "travel"}


def test_without_a_reference_the_report_says_what_cannot_be_known(project: ProjectInMemory) -> None:
    del project.inputs["reference"]
    project.inputs["clips"] = project.inputs["clips"][:2]
    result = quality.run(project, QualityParams(draws=100))
    document = document_of(project, result)
    total = document.measured.totals["skate_height_m_s"]
    assert (total.low, total.high, document.reference, document.changes) == (None, None, None, {})
    page = project.blobs[result["report"]["blob"]].decode()
    assert "Without a reference" in page
    assert "worse than the reference" not in page
    assert "report" not in quality.run(project, QualityParams(report=False))


def test_a_job_that_measures_nothing_fails_with_the_first_reason(project: ProjectInMemory) -> None:
    with pytest.raises(
        JobRefused, match=r"none of 5 clips can be measured; walks/<gliding> 0: .* 60 frames"
    ) as refused:
        quality.run(project, QualityParams(rate_hz=120.0))
    assert refused.value.code == "nothing-measured"
    assert not project.facets
    project.inputs["reference"] = project.inputs["clips"][-1:]
    with pytest.raises(JobRefused, match="none of 1 clip of the reference can be measured; walks/slow: "):
        quality.run(project, QualityParams())


def test_results_under_other_conditions_are_not_compared_and_the_command_is_told() -> None:
    one = QualityConditions(options=QualityOptions(rate_hz=60.0, floor="zero"), draws=1000, seed=0)
    other = QualityConditions(options=QualityOptions(), draws=1000, seed=4)
    assert differing_conditions(one, one) == {}
    assert differing_conditions(one, other) == {"rate_hz": (60.0, 30.0), "floor": ("zero", "planted"), "seed": (0, 4)}
    assert command_with(one) == "marey quality … --rate-hz 60.0 --floor zero --draws 1000 --seed 0"
    spelled = {option.spellings[0] for option in OptionsOf("marey_schemas.queue.job_params:QualityParams").options}
    assert {"--rate-hz", "--floor", "--draws"} <= spelled

    def found(conditions: QualityConditions, **totals: float | None) -> Quality:
        class Ended:
            id = "job_1"
            result = {"conditions": conditions.model_dump(mode="json"), "totals": totals}  # noqa: RUF012

        return Quality(cast(Any, None), cast(Any, Ended()))

    with pytest.raises(
        NotComparable, match=r"rate_hz is 60\.0 and 30\.0.*`marey quality … --rate-hz 60\.0 --floor zero"
    ):
        found(other).changes_since(found(one))
    changes = found(one, skate_ratio=0.5, jitter_m_s3=None).changes_since(found(one, skate_ratio=0.2, jitter_m_s3=9.0))
    assert changes == {"skate_ratio": (0.2, 0.5)}


def test_annotated_contacts_replace_detected_ones(project: ProjectInMemory) -> None:
    """Marey detects no contact in a fast glide; an annotation says that there is one."""
    fast = replace(generate_gait(0.0, 0.0, 2.0), frame_rate_hz=60.0)
    poses = fast.poses.copy()
    poses[:, 2] += 2.0 / 60.0 * np.arange(len(poses))
    project.inputs = {}
    add_clip(project, "fast", replace(fast, poses=poses))
    (clip,) = project.inputs["clips"]
    ref = {"item": clip.item, "revision": 1}
    segments = [{"label": "contact_both", "start": 0, "end": 60}, {"label": "contact_left", "start": 60, "end": 120}]
    project.parts["notes", 1, "annotation"] = {"schema": "marey/annotation@1", "clip": ref, "segments": segments}
    params = QualityParams(report=False, draws=0)
    found = document_of(project, quality.run(project, params)).measured.clips[0].values
    assert found["skate_contact_m_s"] is None
    project.inputs["contacts"] = (
        PinnedInput(item="notes", revision=1, kind=Kind.ANNOTATION, name="notes", collection="walks"),
    )
    document = document_of(project, quality.run(project, params))
    labelled = document.measured.clips[0].values
    assert labelled["skate_contact_m_s"] == pytest.approx(2.0, rel=0.05)
    assert labelled["contact_consistency"] == pytest.approx(0.25, abs=0.02), "only the right foot is free, for half"
    assert document.conditions.contacts == "annotated"
    assert command_with(document.conditions).startswith("marey quality … --contacts … --draws 0")
    del segments[0:2]
    with pytest.raises(JobRefused, match="contact_left or contact_right or contact_both"):
        quality.run(project, params)


def test_the_head_of_a_report_names_the_kinds_of_inputs_in_words(project: ProjectInMemory) -> None:
    pins = tuple(
        PinnedInput(item=f"processed_{n}", revision=n, kind=Kind.PROCESSED, name=f"walk {n}", collection="aligned")
        for n in (1, 2)
    )
    project.inputs = {"aligned": pins}
    assert inputs_of(project) == (("aligned clip", "aligned/walk 1", 1), ("aligned clip", "aligned/walk 2", 2))

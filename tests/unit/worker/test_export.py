"""The function of the job kind `export`, with a project in memory instead of a server."""

import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from tests.support.project_in_memory import ProjectInMemory, add_clip

from marey_motion.gait import generate_gait
from marey_schemas.queue.job_params import ExportParams
from marey_worker.context import JobRefused
from marey_worker.kinds import export

ALLOWED = {"allow_expired_consent": True, "consent_reason": "The estate has agreed."}


@pytest.fixture
def project(tmp_path: Path) -> ProjectInMemory:
    """A project with two clips; the consent for the second one has ended."""
    made = ProjectInMemory(tmp_path)
    for name in ("walk", "stroll"):
        add_clip(made, name, generate_gait(1.4, 0.0, 1.0))
    walk, stroll = made.inputs["clips"]
    made.inputs["clips"] = (walk, stroll.model_copy(update={"consent_ended": "2026-01-31"}))
    return made


def names_in(project: ProjectInMemory, result: dict[str, Any]) -> list[str]:
    with zipfile.ZipFile(BytesIO(project.blobs[result["archive"]["blob"]])) as archive:
        return archive.namelist()


def test_clips_whose_consent_has_ended_are_left_out_with_the_day_and_the_remedies(project: ProjectInMemory) -> None:
    result = export.run(project, ExportParams())
    assert names_in(project, result) == ["walks/walk.bvh"]
    (refusal,) = result["refused"]
    assert (refusal["name"], refusal["item"], refusal["code"]) == ("walks/stroll", "clip_stroll", "consent-expired")
    for said in ("2026-01-31", "consent_until", "maintainer", "allow_expired_consent"):
        assert said in refusal["detail"]
    assert (result["clips"], result["consent_ended"]) == (1, ["clip_stroll"])


def test_clips_whose_consent_has_ended_are_written_if_the_job_allows_it(project: ProjectInMemory) -> None:
    result = export.run(project, ExportParams.model_validate(ALLOWED))
    assert names_in(project, result) == ["walks/stroll.bvh", "walks/walk.bvh"]
    assert (result["clips"], result["refused"], result["consent_ended"]) == (2, [], ["clip_stroll"])


def test_a_job_that_may_write_no_clip_fails_with_the_first_reason(project: ProjectInMemory) -> None:
    project.inputs["clips"] = project.inputs["clips"][1:]
    with pytest.raises(JobRefused, match=r"none of 1 clip .*walks/stroll: .* ended on 2026-01-31") as refused:
        export.run(project, ExportParams())
    assert refused.value.code == "nothing-to-export"


@pytest.mark.parametrize(
    "params",
    [
        {"allow_expired_consent": True},
        {"consent_reason": "why"},
        {"allow_expired_consent": True, "consent_reason": ""},
        {"allow_expired_consent": True, "consent_reason": "  "},
        {"allow_expired_consent": True, "consent_reason": "two\nlines"},
        {"allow_expired_consent": True, "consent_reason": "x" * 501},
    ],
)
def test_a_permission_has_a_reason_of_one_line_and_a_reason_has_a_permission(params: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="consent_reason"):
        ExportParams.model_validate(params)

"""Warnings of the commands of an edit: they are in the result of the job and in the checks of the clip."""

from pathlib import Path

from tests.support.project_in_memory import ProjectInMemory, add_clip

from marey_motion.gait import generate_gait
from marey_schemas.queue.job_params import EditParams
from marey_worker.kinds import edit


def test_a_constraint_that_is_missed_gives_a_warning_in_job_and_clip(tmp_path: Path) -> None:
    project = ProjectInMemory(tmp_path)
    add_clip(project, "walk", generate_gait(1.2, 0.0, 1.0))
    far = {"kind": "position", "joint": "left_wrist", "frames": [20, 40], "point_m": [0.0, 9.0, 0.0]}
    result = edit.run(
        project,
        EditParams.model_validate({"commands": [{"command": "constrain", "constraints": [far]}], "suffix": "-edited"}),
    )
    (warning,) = (one["warning"] for one in result["findings"] if "is missed" in one.get("warning", ""))
    assert warning.startswith("constraints[0] is missed in 20 of 20 frames, by up to ")
    (staged,) = project.staged
    checks = staged.parts["info"]["checks"]
    assert {"code": "edit-warning", "message": f"constrain: {warning}"}.items() <= checks[0].items()

"""Workflow of an edit, with SDK and command line, on a real server with a real worker."""

from __future__ import annotations

import json
from collections.abc import Callable
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.command_line import CommandLine
from tests.support.present import present

from marey_client import Marey
from marey_client.errors import Invalid, JobUnsuccessful, RequestFailed
from marey_client.handles.clips import ClipHandle
from marey_client.project import ProjectHandle
from marey_client.reruns import compare_outputs
from marey_motion.clip import Clip
from marey_motion.documents import clip_from_document, skeleton_from_document
from marey_motion.editing.registry import edit_clip
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.documents.references import RevisionRef
from marey_schemas.editing.edits import EditDocument
from marey_schemas.queue.jobs import Job

pytestmark = pytest.mark.timeout(300)

CLEAN_UP: list[dict[str, Any]] = [
    {"command": "trim", "start": 30, "stop": 150},
    {"command": "smooth", "window_s": 0.2},
    {"command": "face", "heading_deg": 90},
    {"command": "move_to_origin"},
    {"command": "find_contacts"},
]


@pytest.fixture
def lab(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ProjectHandle:
    """A project with three walks: straight ahead, to the left and to the right."""
    for turn_rate_deg_s in (-30, 0, 30):
        walk = generate_gait(1.3, radians(turn_rate_deg_s), 4.0)
        (tmp_path / f"walk {turn_rate_deg_s}.bvh").write_bytes(write_bvh(walk))
    return lab_of(*tmp_path.glob("*.bvh"))


def clips_of(project: ProjectHandle, folder: str) -> dict[str, ClipHandle]:
    return {clip.name: clip for clip in project.clips.list(collection=folder)}


def as_motion(project: ProjectHandle, clip: ClipHandle) -> Clip:
    document = clip.motion()
    assert isinstance(document.skeleton, RevisionRef)
    hierarchy = project.skeletons.get(document.skeleton.item).hierarchy()
    return clip_from_document(document, skeleton_from_document(hierarchy))


def ended(marey: Marey, job: Job) -> Job:
    return marey.jobs.wait(job.id)


def test_an_edit_is_saved_applied_to_a_folder_and_replayed_exactly(marey: Marey, lab: ProjectHandle) -> None:
    edit = lab.edits.save("clean up", CLEAN_UP, title="Middle of the take", collection="edits")
    job = ended(marey, lab.edit("walks", edit, into="clean", tags=("clean",)))
    assert job.result is not None
    assert (job.result["clips"], job.result["refused"]) == (3, [])
    assert {finding["command"] for finding in job.result["findings"]} == {"find_contacts"}

    originals, made = clips_of(lab, "walks"), clips_of(lab, "clean/walks")
    assert made.keys() == originals.keys()
    commands = edit.document().commands
    for name, clip in made.items():
        assert clip.item.tags == ("clean",)
        (here,) = edit_clip(as_motion(lab, originals[name]), commands)
        assert np.array_equal(as_motion(lab, clip).poses, here.clip.poses)
        assert {edge.item for edge in clip.lineage().inputs} == {originals[name].id, edit.id}

    again = ended(marey, lab.edit("walks", CLEAN_UP, into="again"))
    assert again.result is not None
    for name, clip in clips_of(lab, "again/walks").items():
        assert np.array_equal(clip.motion().poses, made[name].motion().poses)


def test_a_job_is_repeated_from_its_record_and_its_results_are_compared(
    marey: Marey, lab: ProjectHandle, run: CommandLine
) -> None:
    job = ended(marey, lab.edit("walks", [{"command": "trim", "start": 30}], into="once"))
    straight = clips_of(lab, "walks")["walk 0"]
    ended(marey, lab.edit(straight, [{"command": "trim", "stop": 60}], in_place=True))  # a newer revision is not read
    done = run("job", "rerun", job.id)
    assert f"in reruns/{job.id}: 3 outputs, 3 identical, 0 with equal content, 0 different" in done.stderr
    found = json.loads(run("job", "rerun", job.id, "--into", "again", "--json").stdout)
    assert [one["comparison"] for one in found["outputs"]] == ["identical"] * 3

    other = ended(marey, lab.edit(straight, [{"command": "trim", "start": 10}], into="other"))
    outputs = [list(marey.jobs.outputs(one.id)) for one in (job, other)]
    compared = {one.name: one for one in compare_outputs(lab, *outputs)}
    assert sorted(one.agreement for one in compared.values()) == ["missing", "missing", "other bytes"]
    (differing,) = (one.difference for one in compared.values() if one.difference is not None)
    assert differing.motion is not None

    in_place = next(one for one in lab.jobs() if one.params.get("in_place"))
    assert "wrote new revisions of its inputs" in run("job", "rerun", in_place.id, status=2).stderr


@pytest.mark.soak
def test_a_job_whose_clips_were_distributed_over_tasks_is_repeated(
    marey: Marey, lab: ProjectHandle, run: CommandLine, tmp_path: Path
) -> None:
    edit_kind = next(kind for kind in marey.jobs.kinds() if kind.name == "edit")
    count = edit_kind.batch_size + 1
    steps = tmp_path / "steps"
    steps.mkdir()
    for number in range(count):
        (steps / f"step {number}.bvh").write_bytes(write_bvh(generate_gait(1.0 + number / 50, 0.0, 0.5, 30)))
    run("upload", str(steps), "--project", "lab", "--collection", "many")
    job = ended(marey, lab.edit("many", [{"command": "trim", "start": 5}], into="cut"))
    assert job.size == 2
    done = run("job", "rerun", job.id)
    assert f"{count} outputs, {count} identical, 0 with equal content, 0 different" in done.stderr


def test_a_list_is_searched_sorted_and_limited_to_stale_results(
    marey: Marey, lab: ProjectHandle, run: CommandLine
) -> None:
    ended(marey, lab.edit("walks", [{"command": "trim", "start": 30}], into="cut"))

    def names(*options: str) -> list[str]:
        return [
            one["name"]
            for one in json.loads(run("ls", "lab", "-r", "--kind", "clip", *options, "--json").stdout)["items"]
        ]

    straight = clips_of(lab, "walks")["walk 0"]
    ended(marey, lab.edit(straight, [{"command": "trim", "stop": 40}], in_place=True))
    assert names("--stale") == ["walk 0"]
    assert names("--sort", "frames")[0] == names("--sort", "-frames")[-1] == "walk 0"
    assert names("--sort", "-updated")[0] == "walk 0"
    assert sorted(names("--find", "WALK -")) == ["walk -30", "walk -30"]
    shown = run("ls", "lab", "--find", "walk 0", "--columns", "frames,seconds").stdout.splitlines()
    assert [line.split() for line in shown if "walks/walk" in line][-1][-2:] == ["40", "0.667"]
    assert "the columns are" in run("ls", "lab", "--sort", "size", status=2).stderr


def test_the_originals_stay_unless_they_are_edited_in_place(marey: Marey, lab: ProjectHandle) -> None:
    before = clips_of(lab, "walks")
    ended(marey, lab.edit("walks", [{"command": "mirror"}], suffix=" mirrored"))
    beside = clips_of(lab, "walks")
    assert beside.keys() == before.keys() | {f"{name} mirrored" for name in before}
    assert all(beside[name].item.revision == 1 for name in before)

    straight = before["walk 0"]
    ended(marey, lab.edit(straight, [{"command": "trim", "stop": 60}], in_place=True))
    after = lab.clips.get(straight.id)
    assert (after.item.revision, after.item.summary["frames"]) == (2, 60)
    assert len(after.motion(revision=1).poses) == straight.item.summary["frames"]
    assert after.info().source is not None
    assert present(after.info().source).file is not None


def test_where_results_should_go_must_be_clear(marey: Marey, lab: ProjectHandle) -> None:
    with pytest.raises(Invalid, match="would have the same folders and names as the clips"):
        lab.edit("walks", [{"command": "mirror"}])
    with pytest.raises(Invalid, match="with in_place the results replace the clips"):
        lab.edit("walks", [{"command": "mirror"}], in_place=True, into="elsewhere")
    (first, *_) = clips_of(lab, "walks").values()
    ended(marey, lab.edit(first, [{"command": "trim", "start": 10}], in_place=True))
    with pytest.raises(JobUnsuccessful, match=f"{first.path}: .* submit the edit again") as stale:
        marey.jobs.wait(lab.edit(first, [{"command": "trim", "start": 20}], in_place=True).id)
    assert stale.value.job.failure.code == "nothing-done"
    assert lab.clips.get(first.id).item.revision == 2


def test_a_split_makes_several_clips_and_others_are_appended_by_name(marey: Marey, lab: ProjectHandle) -> None:
    walks = clips_of(lab, "walks")
    ended(marey, lab.edit(walks["walk 0"], [{"command": "split", "at": [60, 90]}], into="cut"))
    pieces = clips_of(lab, "cut")
    assert {name: clip.item.summary["frames"] for name, clip in pieces.items()} == {
        "walk 0-1": 60,
        "walk 0-2": 30,
        "walk 0-3": walks["walk 0"].item.summary["frames"] - 90,
    }
    joined = [{"command": "concatenate", "source": walks["walk 30"].id}]
    ended(marey, lab.edit(walks["walk 0"], joined, into="joined"))
    (long,) = clips_of(lab, "joined").values()
    assert long.item.summary["frames"] == sum(walks[name].item.summary["frames"] for name in ("walk 0", "walk 30"))
    assert {edge.item for edge in long.lineage().inputs} == {walks["walk 0"].id, walks["walk 30"].id}


def test_a_clip_that_cannot_be_edited_is_refused_and_the_others_are_made(marey: Marey, lab: ProjectHandle) -> None:
    short = clips_of(lab, "walks")["walk -30"]
    ended(marey, lab.edit(short, [{"command": "trim", "stop": 20}], in_place=True))
    job = ended(marey, lab.edit("walks", CLEAN_UP, into="clean"))
    assert job.result is not None
    (refusal,) = job.result["refused"]
    assert (refusal["name"], refusal["code"]) == ("walks/walk -30", "frames-missing")
    assert "commands[0] (trim)" in refusal["detail"]
    assert clips_of(lab, "clean").keys() == {"walk 0", "walk 30"}

    with pytest.raises(JobUnsuccessful, match="none of 3 clips can be edited; walks/") as nothing:
        marey.jobs.wait(lab.edit("walks", [{"command": "trim", "start": 100_000}], into="none").id)
    assert nothing.value.job.failure.code == "nothing-done"


def test_a_preview_shows_what_the_job_makes_and_stores_nothing(marey: Marey, lab: ProjectHandle) -> None:
    walk = clips_of(lab, "walks")["walk 30"]
    shown = walk.preview(CLEAN_UP, frames=slice(20, 50), fields=("motion", "positions", "findings"))
    assert (shown.pieces, shown.frame_count, shown.frames) == (1, 120, (20, 50))
    assert [finding["command"] for finding in shown.findings] == ["find_contacts"]
    assert {clip.path for clip in lab.clips.list()} == {f"walks/walk {rate}" for rate in (-30, 0, 30)}
    assert walk.item.revision == 1

    edit = lab.edits.save("clean up", EditDocument.model_validate({"commands": CLEAN_UP}))
    ended(marey, lab.edit(walk, edit, into="clean"))
    (made,) = clips_of(lab, "clean").values()
    assert shown.motion is not None
    assert np.array_equal(shown.motion.poses, made.motion(frames=slice(20, 50)).poses)
    assert np.array_equal(present(walk.preview(edit, frames=slice(20, 50)).motion).poses, shown.motion.poses)
    with pytest.raises(RequestFailed, match=r"commands\[0\] \(trim\)"):
        walk.preview([{"command": "trim", "start": 100_000}])


def test_an_animator_edits_from_the_command_line(lab: ProjectHandle, run: CommandLine, tmp_path: Path) -> None:
    walk = "lab/walks/walk 0"
    told = run("edit", "preview", walk, "--do", "trim start=10 stop=100", "--do", "find_ground").stdout
    assert "0:90 of 90" in told
    assert "find_ground: height_m -0.02" in told
    shown = json.loads(run("edit", "preview", walk, "--do", "mirror", "--frames", "5:7", "--json").stdout)
    assert (shown["frames"], len(shown["motion"]["poses"]["data"])) == ([5, 7], 2)

    given = ("--do", "smooth joints=Head,Neck frames=10:90", "--do", "concatenate source='lab/walks/walk 30'")
    run("edit", "save", "lab/edits/longer", "--title", "Longer", *given)
    listed = run("edit", "show", "lab/edits/longer").stdout
    assert listed.startswith("Longer\n  0  smooth")
    assert clips_of(lab, "walks")["walk 30"].id in listed
    (tmp_path / "edit.json").write_text(run("edit", "show", "lab/edits/longer", "--json").stdout)
    assert "revision 1" in run("edit", "save", "lab/edits/longer", "--file", "edit.json").stdout

    assert "such as json" in run("download", "lab/edits/longer", "-o", "edits", status=1).stderr
    run("download", "lab/edits/longer", "-o", "edits", "--format", "json")
    assert "smooth" in (tmp_path / "edits/longer.json").read_text()

    told = run("edit", "apply", "lab/walks", "--with", "lab/edits/longer", "--into", "longer", "--tag", "long").stdout
    assert "3 clips" in told
    assert "0 refused" in told
    assert {clip.item.tags for clip in lab.clips.list(collection="longer")} == {("long",)}
    piped = run("edit", "apply", walk, "--file", "-", "--suffix", "-short", stdin='[{"command": "trim", "stop": 9}]')
    assert "1 clip," in piped.stdout
    assert clips_of(lab, "walks")["walk 0-short"].item.summary["frames"] == 9


WRONG: tuple[tuple[tuple[str, ...], int, str], ...] = (
    (("edit", "apply", "lab/walks", "--do", "mirror"), 2, "choose where the results go"),
    (("edit", "apply", "lab/walks", "--into", "x"), 2, "give commands with --do or --file"),
    (("edit", "apply", "lab/walks", "--do", "wobble", "--into", "x"), 2, "there is no command 'wobble'"),
    (("edit", "apply", "lab/walks", "--do", "trim start=9 stop=3", "--into", "x"), 2, "must be after"),
    (("edit", "preview", "lab/walks/walk 0", "--do", "trim start=9999"), 1, "commands[0] (trim)"),
    (("edit", "preview", "lab/walks/none", "--do", "mirror"), 2, "there is no clip at lab/walks/none"),
    (
        ("edit", "preview", "lab/walks/walk 0", "--do", "paste joints=Head source=lab/walks/x"),
        2,
        "there is no clip",
    ),
    (("edit", "show", "lab/edits/none"), 2, "there is no edit at"),
    (("edit", "apply", "lab/walks", "--do", "trim stop=99999", "--into", "x"), 1, "the range 0:99999"),
)


def test_what_went_wrong_is_told_in_a_line(lab: ProjectHandle, run: CommandLine) -> None:
    for arguments, status, told in WRONG:
        done = run(*arguments, status=status)
        assert told in done.stderr
        assert "Traceback" not in done.stderr
    assert {clip.item.collection for clip in lab.clips.list()} == {"walks"}

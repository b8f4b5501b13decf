"""The how-to pages about sets of clips, searches by example and pipelines, run as printed."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.support.command_line import CommandLine
from tests.support.printed_pages import ROOT, PrintedPage
from tests.support.short_walks import write_named_walks

from marey_client import Marey
from marey_client.project import ProjectHandle
from marey_motion.clip import Clip
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait

Reads = Callable[..., PrintedPage]
AddWalks = Callable[..., None]

pytestmark = [
    pytest.mark.soak,
    pytest.mark.timeout(900),
    pytest.mark.parametrize("server", ["sqlite"], indirect=True, scope="session"),
]

GAITS = ("run", "walk", "walk-left", "walk-right", "dash")
FEW_TRIALS = ("--speeds", 1, "--turns=-50:50:50", "--duration", 4, "--replicates", 3, "--no-baseline")
FEW_REPLICATES = ("--estimation-replicates", 1, "--confirmation-replicates", 3)


def test_improve_a_data_set(
    empty_lab: ProjectHandle,
    add_walks: AddWalks,
    name_skeletons: Callable[..., None],
    reads: Reads,
    tmp_path: Path,
) -> None:
    add_walks("rigs", "rig")
    name_skeletons("bandai-namco (163 cm)")
    write_named_walks(tmp_path / "bandai-namco-1", *(f"dataset-1_{gait}_normal_001" for gait in GAITS), seconds=3.0)
    write_named_walks(
        tmp_path / "bandai-namco-2",
        *(f"dataset-2_{gait}_active_002" for gait in ("bow", "walk-turn-left", "walk-turn-right", "walk", "run")),
        seconds=3.0,
    )
    page = reads(
        "docs/how-to/improve-a-data-set.md",
        shortened={
            "marey evaluate": FEW_TRIALS,
            "marey suggest": ("--removals", 1, *FEW_REPLICATES),
            "marey optimise": FEW_REPLICATES,
        },
        names={"lab": empty_lab, "Path": Path},
    )
    page.follow(1)
    assert len(list(empty_lab.clips.list(collection="set"))) == len(GAITS)
    assert len(list(empty_lab.clips.list(collection="candidates"))) == 4
    page.follow(2)
    assert "the mean distance from the path varies by" in page.printed("marey suggest")
    assert (tmp_path / "before.html").is_file()
    assert (tmp_path / "names.txt").is_file()
    page.follow(3)
    assert "6 trials" in page.printed("marey compare")
    assert "Ended" in page.printed("marey optimise")
    assert "best weight" in page.printed("marey sweep")
    page.names["ids"] = [empty_lab.evaluations[name].id for name in ("before", "with-turns")]
    page.follow()
    assert (tmp_path / "compared.html").is_file()
    assert page.names["influences"]


def test_find_similar_motion(empty_lab: ProjectHandle, add_walks: AddWalks, reads: Reads, run: CommandLine) -> None:
    add_walks("raw", "walk", "turn", seconds=8.0)
    add_walks("studio", "stand", seconds=3.0)
    run("metric", "store", "published/sigmoid", "lab/metrics/paper")
    page = reads("docs/how-to/find-similar-motion.md")
    page.follow(1)
    assert "3 clips, 0 of them new" in page.printed("marey index lab/raw")
    assert "3 clips, 3 of them new" in page.printed("marey index lab")
    page.follow(2)
    assert "metric: published/sigmoid" in page.printed("marey similar lab/raw/walk:120-180 --metric published")
    assert json.loads(page.printed("marey similar lab/raw/walk:120-180 --leave-out clip --json"))
    page.follow(1)
    assert "raw/walk" in page.printed("marey ls lab --query")
    assert "walk-like" in empty_lab.clips["raw/walk"].item.tags
    page.follow()
    assert "raw/turn" in page.printed("from marey import")


def write_reaches(folder: Path) -> None:
    """Write six takes of a standing body that raises its right arm once, further in each take."""
    folder.mkdir()
    for number in range(6):
        clip = generate_gait(0.0, 0.0, 4.0, 30)
        times = np.linspace(0, 1, clip.frame_count)
        angles = (1.0 + number / 20) * np.exp(-(((times - 0.5) / 0.12) ** 2))
        poses = clip.poses.copy()
        first = 3 + 4 * clip.skeleton.joint_names.index("RightArm")
        poses[:, first : first + 4] = 0.0
        poses[:, first], poses[:, first + 2] = np.cos(angles / 2), np.sin(angles / 2)
        (folder / f"reach-{number}.bvh").write_bytes(
            write_bvh(Clip(clip.skeleton, clip.frame_rate_hz, poses, clip.translations, clip.translated_joints))
        )


def test_pipelines(
    empty_lab: ProjectHandle,
    marey: Marey,
    add_walks: AddWalks,
    name_skeletons: Callable[..., None],
    reads: Reads,
    run: CommandLine,
    tmp_path: Path,
) -> None:
    add_walks("rigs", "rig", stature_m=1.70)
    name_skeletons("studio")
    write_named_walks(tmp_path / "takes", *(f"walk-{number:03}" for number in range(6)), seconds=3.0)
    write_reaches(tmp_path / "reaches")
    run("upload", "reaches", "--project", "lab", "--collection", "raw")
    run("edit", "apply", "lab/rigs", "--do", "trim start=9000", "--into", "trimmed", status=1)
    (job,) = [one for one in empty_lab.jobs() if one.state == "failed"]
    quick = ("--set", "model.report=false", "--set", "tree.samples=100")
    page = reads(
        "docs/how-to/pipelines.md",
        replaced={"JOB": job.id},
        shortened={"marey build-model takes": quick},
    )
    page.follow(2)
    folders = ("takes", "retargeted", "annotations", "pieces", "aligned", "step-left")
    listed = run("ls", "lab/step-left").stdout
    assert [name for name in folders if name not in listed] == []
    assert empty_lab.models["reach/reach"]
    model = empty_lab.models["step-left/step-left"]
    write_named_walks(tmp_path / "takes", "walk-003", seconds=3.5)
    run("upload", "takes", "--project", "lab", "--collection", "step-left/takes")
    page.follow(1)
    assert "stale" in page.printed("marey show")
    assert empty_lab.models["step-left/step-left"].item.revision > model.item.revision
    page.follow(1)
    assert page.printed("marey job retry").startswith("job_")
    (graph,) = re.findall(r"```json\n(.*?)```", (ROOT / page.page).read_text(encoding="utf-8"), re.DOTALL)
    document = json.loads(graph.replace("skeleton_…", empty_lab.skeletons["skeletons/studio"].id))
    trials = {"speeds_m_s": [1.0], "turn_rates_deg_s": [0.0], "duration_s": 4.0, "replicates": 1, "report": False}
    document["steps"]["measured"]["params"] |= trials
    (tmp_path / "graph.json").write_text(json.dumps(document), encoding="utf-8")
    page.follow(1)
    assert [one.path for one in empty_lab.evaluations] == ["moved-eval"]
    page.follow()
    page.names["run"].wait()
    assert sorted({one.item.collection for one in empty_lab.clips.list(collection="game")}) == ["game/raw"]

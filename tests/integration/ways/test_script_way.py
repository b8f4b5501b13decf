"""Workflow of scripts: the commands and the Python of the how-to page, with a Git repository and a real worker."""

from __future__ import annotations

import contextlib
import json
import re
import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from tests.support.command_line import CommandLine
from tests.support.git_repositories import committed
from tests.support.server_process import QUICK_LEASES, ServerProcess

from marey_client import Marey
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import ItemInput
from marey_schemas.queue.own_pods import with_digest
from marey_schemas.queue.scripts import ScriptCreate

pytestmark = pytest.mark.timeout(300)

TEXT = (Path(__file__).parents[3] / "docs" / "how-to" / "run-your-own-scripts.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


@pytest.fixture
def lab(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ProjectHandle:
    (tmp_path / "walk.bvh").write_bytes(write_bvh(generate_gait(1.3, 0.5, 3.0)))
    return lab_of(tmp_path / "walk.bvh", collection="studio")


def test_the_commands_and_the_python_of_the_page_work_in_their_order(
    marey: Marey, lab: ProjectHandle, run: CommandLine, script_repositories: Path, tmp_path: Path
) -> None:
    measure, python, fit, comparison = blocks("python")
    address, commit = committed(script_repositories / "page", {"measure.py": measure, "fit.py": fit})
    *declarations, image = map(json.loads, blocks("json"))
    with_digest(image["image"])  # only its form is checked: scripts with an image run in a cluster
    for name, declared in zip(("measure", "fit"), declarations, strict=True):
        (tmp_path / f"{name}.json").write_text(json.dumps(declared | {"repository": address, "commit": commit}))
    *commands, removal = [line for block in blocks("sh") for line in block.splitlines()]
    printed = {line: run(*shlex.split(line)[1:]).stdout for line in commands}
    first, second = (text for line, text in printed.items() if "run lab measure" in line)
    table = next(text for line, text in printed.items() if "runs lab measure" in line)
    lengths = [float(re.findall(r"path\s+(\S+)", text)[0]) for text in (first, second)]
    assert lengths[1] == pytest.approx(2.5 * lengths[0])
    assert lengths[0] > 100, "centimetres of a walk of three seconds"
    factors = [line.split()[1] for line in table.splitlines() if "job_" in line]
    assert factors == ["2.5", "1"], table
    copies = list(lab.clips.list(collection="measured"))
    assert [copy.name for copy in copies] == ["measure-copy"]
    check_comparisons({line: text for line, text in printed.items() if " compare " in line}, tmp_path)
    space: dict[str, Any] = {"project": lab, "marey": marey, "ItemInput": ItemInput}
    exec(compile(python, "run-your-own-scripts.md", "exec"), space)
    assert space["best"].values == {"factor": 4.0}
    exec(compile(comparison, "run-your-own-scripts.md", "exec"), space)
    found = space["found"]
    assert (found.curves, [len(setting.runs) for setting in found.settings]) == (("loss",), [1, 3])
    assert found.settings[1].fields["loss"].high > found.settings[1].fields["loss"].mean
    assert found.runs[0].curves["loss"].steps == tuple(range(50))
    run(*shlex.split(removal)[1:])
    assert [one.name for one in lab.scripts.list()] == ["fit"]


def check_comparisons(printed: dict[str, str], folder: Path) -> None:
    """Check the tables and the files of the commands that compare the runs of `fit`."""
    table, means, exact, _, _ = printed.values()
    marked = [line.split() for line in table.splitlines() if "*" in line]
    assert [row[2] for row in marked] == ["0.05"], table
    assert [line.split()[:2] for line in means.splitlines() if "0.0" in line] == [["0.05", "1"], ["0.02", "3"]], means
    assert means.count(" to ") == 1, "only three seeds have an interval"
    head, *rows = exact.splitlines()
    assert (head, len(rows)) == ("job,seed,rate,loss", 4)
    text = (folder / "runs.html").read_text()
    assert "rate=0.05 has the lowest loss" in text
    assert "thin lines are runs with different seeds" in text
    assert (folder / "loss.png").read_bytes().startswith(b"\x89PNG")


SLOW = """import sys, time
from pathlib import Path
print("the script runs", flush=True)
time.sleep(float(sys.argv[1]))
Path(sys.argv[2]).write_text('{"slept": 1}')
"""


def script_processes() -> list[psutil.Process]:
    """Return the processes that run the script `SLOW`, whoever is their parent."""
    found = []
    for one in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if "code/slow.py" in one.cmdline():
                found.append(one)
    return found


def wait_until(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.1)


@pytest.mark.soak
def test_a_cancelled_run_ends_at_once_and_the_run_of_a_killed_worker_is_repeated(tmp_path: Path) -> None:
    where = {"MAREY_SCRIPT_REPOSITORIES": json.dumps([f"file://{tmp_path}/"])}
    process = ServerProcess(tmp_path, **where, **QUICK_LEASES).start(workers=1)
    try:
        with process.client() as marey:
            lab = marey.create_project(ProjectCreate(name="lab"))
            declared: dict[str, Any] = {"argv": ["python", "slow.py", "{parameter:seconds}", "{output:fields}"]}
            declared |= {"parameters": {"seconds": {}}, "outputs": {"fields": {"kind": "fields"}}}
            address, commit = committed(tmp_path / "slow", {"slow.py": SLOW})
            wanted = {"name": "slow", "repository": address, "commit": commit, **declared}
            lab.scripts.register(ScriptCreate.model_validate(wanted))
            cancelled = lab.scripts.at("slow").run({"seconds": 600})
            wait_until(script_processes, "the script does not run")
            marey.jobs.cancel(cancelled.id)
            assert marey.jobs.wait(cancelled.id, timeout_s=60, require_success=False).state == "cancelled"
            wait_until(lambda: not script_processes(), "the script of the cancelled job still runs")
            job = lab.scripts.at("slow").run({"seconds": 5})
            wait_until(script_processes, "the script does not run")
            assert process.process is not None
            children = psutil.Process(process.process.pid).children()
            (worker,) = [one for one in children if "marey_worker" in one.cmdline()]
            (before,) = script_processes()
            worker.kill()
            wait_until(lambda: not before.is_running(), "the script outlives its worker")
            ended = marey.jobs.wait(job.id, timeout_s=120)
            assert [one.outcome for one in marey.jobs.attempts(job.id)] == ["lost", "succeeded"]
            assert ended.result is not None
            assert ended.result["fields"] == {"slept": 1}
            states = [(one.state, one.fields) for one in lab.scripts.at("slow").runs(sort="fields.slept")]
            assert states == [("succeeded", {"slept": 1}), ("cancelled", {})]
    finally:
        process.stop()
    process.check_database()

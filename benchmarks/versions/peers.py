"""Times of Git, DVC and Oxen for the jobs of versions, with as many small files as a dataset has entries.

Git and DVC are run as commands, so their times include starting these commands. Git writes only to the index, the
objects and the branch, not to a working tree. DVC and Oxen read the changed file from a folder of files. A branch of a
dataset in DVC is a branch in Git. The Python package of Oxen compares single files, but not two versions.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from benchmarks.versions.filling import path_of
from marey_schemas.datasets.naming import MAIN

COMMIT, DIFFERENCE, BRANCH = "commit of one change", "difference of 20 changes", "branch"
FILES = 10_000
"""Number of files with which DVC and Oxen are measured; creating them and the first commit take less than a minute."""
REPEATS = 3
CHANGES = 20
DVC, OXEN = "MAREY_BENCH_DVC", "MAREY_BENCH_OXEN"
"""Environment variables: Python interpreters of environments with DVC and with Oxen."""


@dataclass(frozen=True)
class PeerTimes:
    """Median times in ms of a peer by job, and the text of each job for the report."""

    times_ms: Mapping[str, float]
    shown: Mapping[str, str] = field(default_factory=dict)


def measure_peers(sizes: Sequence[int]) -> dict[int, list[PeerTimes]]:
    """Measure Git with each number of files, and the other peers with `FILES` files."""
    found = {size: [_of_peer("Git", size, shutil.which("git"), _git)] for size in sizes}
    found[FILES] += [
        _of_peer("DVC", FILES, os.environ.get(DVC), _dvc),
        _of_peer("Oxen", FILES, os.environ.get(OXEN), _oxen),
    ]
    return found


def _of_peer(
    name: str, files: int, program: str | None, measure: Callable[[str, Path, int], dict[str, list[float]]]
) -> PeerTimes:
    if program is None:
        return PeerTimes({}, dict.fromkeys((COMMIT, DIFFERENCE, BRANCH), f"{name} is not installed"))
    with tempfile.TemporaryDirectory(prefix="marey-bench-peer-") as folder:
        times = measure(os.path.abspath(program), Path(folder), files)  # the peer runs in another folder
    medians = {job: statistics.median(some) for job, some in times.items()}
    shown = {job: f"{name}, {files:,} files: {median:.0f} ms" for job, median in medians.items()}
    if DIFFERENCE not in shown:
        shown[DIFFERENCE] = f"{name}: not supported"
    return PeerTimes(medians, shown)


def _time_ms(action: Callable[[], object]) -> float:
    begun = time.perf_counter()
    action()
    return (time.perf_counter() - begun) * 1e3


# -- Git --------------------------------------------------------------------------------------------------------------


def _git(git: str, folder: Path, files: int) -> dict[str, list[float]]:
    run = partial(_run, folder, git)
    run("init", "-q")
    run("fast-import", "--quiet", given=b"".join(_history(files)))
    run("read-tree", MAIN)

    def stage(numbers: Sequence[int], content: str) -> list[str]:
        changed = run("hash-object", "-w", "--stdin", given=content.encode())
        return [part for number in numbers for part in ("--cacheinfo", f"100644,{changed},{path_of(number)}")]

    def commit(staged: Sequence[str]) -> None:
        run("update-index", *staged)
        made = run("commit-tree", "-m", "m", "-p", MAIN, run("write-tree"))
        run("update-ref", f"refs/heads/{MAIN}", made)

    staged = [stage([number], f"changed {number}") for number in range(REPEATS)]
    commits = [_time_ms(partial(commit, one)) for one in staged]
    commit(stage(range(0, files, files // CHANGES)[:CHANGES], "changed"))
    return {
        COMMIT: commits,
        DIFFERENCE: _repeated(run, "diff-tree", "-r", "--name-status", f"{MAIN}~1", MAIN),
        BRANCH: [_time_ms(partial(run, "branch", f"b{number}", MAIN)) for number in range(REPEATS)],
    }


def _history(files: int) -> Iterator[bytes]:
    """Yield the input of `git fast-import` for one commit of `files` files."""
    yield f"commit refs/heads/{MAIN}\ncommitter bench <bench@localhost> 0 +0000\ndata 5\nfirst\n".encode()
    for number in range(files):
        content = f"take {number}"
        yield f"M 100644 inline {path_of(number)}\ndata {len(content)}\n{content}\n".encode()


def _repeated(run: Callable[..., str], *arguments: str) -> list[float]:
    return [_time_ms(partial(run, *arguments)) for _ in range(REPEATS)]


# -- DVC and Oxen -----------------------------------------------------------------------------------------------------

DATA = "data"


def _write_files(folder: Path, files: int) -> None:
    for number in range(files):
        path = folder / DATA / path_of(number)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"take {number}")


def _dvc(python: str, folder: Path, files: int) -> dict[str, list[float]]:
    git, dvc = partial(_run, folder, shutil.which("git") or "git"), partial(_run, folder, python, "-m", "dvc")
    git("init", "-q", "-b", MAIN)
    dvc("init", "-q")
    dvc("config", "core.analytics", "false")

    def commit() -> None:
        dvc("add", "-q", DATA)
        git("add", "-A")
        git("commit", "-q", "-m", "m")

    def change(numbers: Sequence[int], content: str) -> None:
        for number in numbers:
            Path(folder, DATA, path_of(number)).write_text(content)

    _write_files(folder, files)
    commit()
    commits = []
    for number in range(REPEATS):
        change([number], f"changed {number}")
        commits.append(_time_ms(commit))
    change(range(0, files, files // CHANGES)[:CHANGES], "changed")
    commit()
    return {
        COMMIT: commits,
        DIFFERENCE: _repeated(dvc, "diff", "HEAD~1", "HEAD"),
        BRANCH: [_time_ms(partial(git, "branch", f"b{number}")) for number in range(REPEATS)],
    }


def _oxen(python: str, folder: Path, files: int) -> dict[str, list[float]]:
    _write_files(folder, files)
    script = str(Path(__file__).with_name("oxen_peer.py").resolve())
    times = json.loads(_run(folder, python, script, str(folder), DATA, f"{DATA}/{path_of(0)}").splitlines()[-1])
    return {COMMIT: times["commit"], BRANCH: times["branch"]}


def _run(folder: Path, program: str, *arguments: str, given: bytes | None = None) -> str:
    """Run a program in a folder, which is also its home folder, and return what it prints."""
    person = {f"GIT_{role}_{what}": "bench@localhost" for role in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    environment = {**os.environ, **person, "HOME": str(folder), "DVC_NO_ANALYTICS": "1"}
    ran = subprocess.run(
        [program, *arguments], cwd=folder, env=environment, check=False, input=given, capture_output=True
    )
    if ran.returncode:
        raise RuntimeError(f"{' '.join([program, *arguments][:6])}: {ran.stderr.decode(errors='replace')[-2000:]}")
    return ran.stdout.decode().strip()

"""Times of Oxen with small files, for comparison: `python benchmarks/versions/oxen_peer.py FOLDER FIRST CHANGED`.

The interpreter needs `oxenai`, and no package of this repository. The folder contains the files. The script commits
them, then several times another content of the file CHANGED, and creates branches. It prints the times as JSON, in ms.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import oxen

REPEATS = 5


def _time_ms(action: Callable[[], object]) -> float:
    begun = time.perf_counter()
    action()
    return (time.perf_counter() - begun) * 1e3


def main(folder: str, first: str, changed: str) -> None:
    """Measure commits of one changed file, and branches."""
    oxen.user.config_user("bench", "bench@localhost")
    repository = oxen.Repo(folder)
    repository.init()
    repository.add(str(Path(folder, first)))
    repository.commit("first")
    file = Path(folder, changed)

    def commit() -> None:
        repository.add(str(file))
        repository.commit("m")

    commits = []
    for number in range(REPEATS):
        file.write_text(f"changed {number}")
        commits.append(_time_ms(commit))
    branches = [_time_ms(partial(repository.checkout, f"b{number}", create=True)) for number in range(REPEATS)]
    print(json.dumps({"commit": commits, "branch": branches}))


if __name__ == "__main__":
    main(*sys.argv[1:])

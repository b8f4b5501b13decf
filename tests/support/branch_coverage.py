"""Comparison of the branch coverage of each package with a minimum, from the data of the last run with `--cov`.

`python -m tests.support.branch_coverage` exits with 1 if a package is below its minimum. Branches in compiled functions
and in processes that tests start are not measured.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter
from pathlib import Path

import coverage

FLOORS = {
    "marey_schemas": 86,
    "marey_versions": 92,
    "marey_motion": 86,
    "marey_reports": 72,
    "marey": 90,
    "marey_client": 38,
    "marey_server": 82,
    "marey_worker": 55,
}
"""Minimum coverage in percent, by package: 2 to 3 percentage points below the coverage of a whole run of `make check`.

Half of the client runs only in the workflows of `make test`, and a part of the reports only in slow tests, which draw
reports. Most kinds of jobs, the limits, and the fork server in
`marey_schemas.processes` mostly run in child processes, which are not measured.
"""


def branch_coverage() -> dict[str, float]:
    """Return the percentage of taken branches by package; 0 for a package that no test has imported."""
    measured = coverage.Coverage()
    measured.load()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "coverage.json"
        measured.json_report(outfile=str(report))
        files = json.loads(report.read_text(encoding="utf-8"))["files"]
    taken: Counter[str] = Counter()
    there: Counter[str] = Counter()
    for name, file in files.items():
        package = next(part for part in reversed(Path(name).parts) if part in FLOORS)
        taken[package] += file["summary"]["covered_branches"]
        there[package] += file["summary"]["num_branches"]
    return {package: 100.0 * taken[package] / max(1, there[package]) for package in FLOORS}


def main() -> int:
    """Print a line for each package; return 1 if the coverage of a package is below its minimum."""
    found = branch_coverage()
    for package, percent in found.items():
        floor = FLOORS[package]
        verdict = "" if percent >= floor else "  below its floor: cover what you added, or remove what nothing uses"
        print(f"{package:14} {percent:5.1f} % of branches (floor {floor} %){verdict}")
    return int(any(percent < FLOORS[package] for package, percent in found.items()))


if __name__ == "__main__":
    sys.exit(main())

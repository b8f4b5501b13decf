"""Run all benchmarks, or only the named ones: `python -m benchmarks bvh kinematics`."""

from __future__ import annotations

import argparse
import importlib
import json
import pkgutil
import platform
import sys
from dataclasses import asdict

from rich.console import Console
from rich.table import Table

import benchmarks
from benchmarks.timing import Row

_VERDICTS = {True: "met", False: "[bold]missed[/bold]", None: ""}


def main() -> int:
    """Print a table of the results; return the exit status, which is 1 if `--strict` is given and a goal was missed."""
    names = sorted(
        module.name.removeprefix("bench_")
        for module in pkgutil.iter_modules(benchmarks.__path__)
        if module.name.startswith("bench_")
    )
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "names", nargs="*", metavar="name", help=f"benchmarks to run, of {', '.join(names)}; default: all"
    )
    parser.add_argument("--json", metavar="FILE", help="file to which the rows are also written as JSON")
    parser.add_argument("--strict", action="store_true", help="fail when a goal is missed")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(names):
        parser.error(f"no benchmark {', '.join(sorted(unknown))}; there are {', '.join(names)}")

    console = Console(width=150)
    console.print(
        f"{platform.python_implementation()} {platform.python_version()}, {platform.machine()}, {platform.system()}"
    )
    rows: list[Row] = []
    try:
        for name in arguments.names or names:
            console.print(f"running {name} …")
            rows += importlib.import_module(f"benchmarks.bench_{name}").run()
    finally:  # a benchmark that fails must not take the results of the others with it
        console.print(_table(rows))
        if arguments.json:
            with open(arguments.json, "w", encoding="utf-8") as file:
                json.dump([asdict(row) for row in rows], file, indent=2)
    return int(arguments.strict and any(row.met is False for row in rows))


def _table(rows: list[Row]) -> Table:
    table = Table(title="Marey beside other libraries: medians (best), and their ratios", title_justify="left")
    for heading, justify in (
        ("job", "left"),
        ("size", "left"),
        ("Marey", "right"),
        ("peer", "right"),
        ("ratio", "right"),
        ("goal", "left"),
        ("", "left"),
    ):
        table.add_column(heading, justify=justify)
    for row in rows:
        ratio = f"{row.ratio:.1f}x" if row.ratio is not None else ""
        table.add_row(row.job, row.size, row.ours, row.peer, ratio, row.goal, _VERDICTS[row.met])
    return table


if __name__ == "__main__":
    sys.exit(main())

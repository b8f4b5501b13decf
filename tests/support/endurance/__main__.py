"""Long trials of an installation with Postgres and S3: `python -m tests.support.endurance faults` or `load`.

`faults` runs mixed jobs once undisturbed and once while processes are killed; `load` sends requests at a stated rate.
The exit status is 1 if a rule was broken.
"""

from __future__ import annotations

import argparse
import secrets
import sys
import time
from pathlib import Path

from tests.support.endurance import trial_by_faults, trial_by_load
from tests.support.endurance.faults import FAULTS
from tests.support.endurance.installation import WORKERS
from tests.support.endurance.workload import KINDS


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.support.endurance")
    trials = parser.add_subparsers(dest="trial", required=True)
    faults = trials.add_parser("faults", help="check that mixed jobs have the same results under faults")
    faults.add_argument("--rounds", type=int, default=1_340, help="calls that submit jobs (default: 1340; 2010 jobs)")
    faults.add_argument("--seconds", type=float, default=600, help="seconds in which faults happen (default: 600)")
    faults.add_argument("--every", type=float, default=3.0, help="mean seconds between two faults (default: 3)")
    faults.add_argument("--slow", type=float, default=0.0, help="seconds for which a job draws a skeleton (default: 0)")
    faults.add_argument(
        "--jobs", action="append", default=[], choices=sorted(KINDS), help="submit only this kind of job (repeatable)"
    )
    faults.add_argument(
        "--only",
        action="append",
        default=[],
        choices=sorted(FAULTS),
        help="inject only this kind of fault (repeatable)",
    )
    faults.add_argument("--without-fence", action="store_true", help="do not compare fences: the trial must fail")
    faults.add_argument("--logs", type=Path, help="folder to which the logs are copied at the end")
    load = trials.add_parser("load", help="check waits of reads, heartbeats, and the memory of servers")
    load.add_argument("--minutes", type=float, default=30, help="duration of the trial (default: 30)")
    load.add_argument("--rate", type=float, default=20, help="requests per second (default: 20)")
    load.add_argument(
        "--read-ms",
        type=float,
        default=1_000,
        help="limit for the 99th percentile of reads and lists, ms (default: 1000)",
    )
    for one, workers in ((faults, WORKERS), (load, 2)):
        one.add_argument("--seed", type=int, default=None, help="seed of the faults or requests (default: random)")
        one.add_argument(
            "--s3", choices=["seaweedfs", "moto"], default="seaweedfs", help="S3 server (default: seaweedfs)"
        )
        one.add_argument("--workers", type=int, default=workers, help="number of workers (default: %(default)s)")
    return parser


def main() -> None:
    """Run a trial."""
    given = _parser().parse_args()
    seed = secrets.randbelow(2**32) if given.seed is None else given.seed
    begun = time.monotonic()

    def say(text: str) -> None:
        print(f"{time.monotonic() - begun:6.1f} s  {text}", flush=True)

    say(f"the seed is {seed}")
    if given.trial == "load":
        trial = trial_by_load.LoadTrial(given.minutes, given.rate, seed, given.s3, given.workers, given.read_ms)
        broken = trial_by_load.run(trial, say)
    else:
        broken = trial_by_faults.run(
            trial_by_faults.FaultTrial(
                given.rounds, given.seconds, seed, given.every, given.s3, given.workers, given.only, given.slow,
                not given.without_fence, given.jobs, given.logs,
            ),
            say,
        )  # fmt: skip
    for one in broken:
        say(f"BROKEN {one}")
    say(f"{len(broken)} rules broken; the seed was {seed}")
    sys.exit(1 if broken else 0)


if __name__ == "__main__":
    main()

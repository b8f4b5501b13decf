"""Long trials of an installation with Postgres and S3: `python -m tests.support.endurance faults` or `load`."""

from __future__ import annotations

import argparse
import secrets
import sys
import time
from pathlib import Path

from tests.support.endurance.faults import FAULTS
from tests.support.endurance.trial_by_faults import FaultTrial, run
from tests.support.endurance.workload import KINDS


def main() -> None:
    """Run a trial; the exit status is 1 if a rule was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.endurance", description=__doc__)
    trials = parser.add_subparsers(dest="trial", required=True)
    faults = trials.add_parser("faults", help="mixed jobs while processes are killed; the results must be the same")
    faults.add_argument("--rounds", type=int, default=1_150, help="1,150 rounds are 2,000 jobs")
    faults.add_argument("--seconds", type=float, default=600, help="duration of the faults")
    faults.add_argument("--every", type=float, default=3.0, help="mean seconds between two faults")
    faults.add_argument("--seed", type=int, default=None, help="the same seed gives the same faults")
    faults.add_argument("--s3", choices=["seaweedfs", "moto"], default="seaweedfs")
    faults.add_argument("--workers", type=int, default=6)
    faults.add_argument("--slow", type=float, default=0.0, help="seconds that each drawn skeleton takes")
    faults.add_argument("--jobs", action="append", default=[], choices=sorted(KINDS), help="only these kinds of jobs")
    faults.add_argument("--logs", type=Path, help="folder to which the logs are copied at the end")
    faults.add_argument("--only", action="append", default=[], choices=sorted(FAULTS))
    faults.add_argument("--without-fence", action="store_true", help="negative control: the trial must find faults")
    given = parser.parse_args()
    seed = secrets.randbelow(2**32) if given.seed is None else given.seed
    begun = time.monotonic()

    def say(text: str) -> None:
        print(f"{time.monotonic() - begun:6.1f} s  {text}", flush=True)

    say(f"the seed is {seed}")
    trial = FaultTrial(
        given.rounds, given.seconds, seed, given.every, given.s3, given.workers, given.only, given.slow,
        not given.without_fence, given.jobs, given.logs,
    )  # fmt: skip
    broken = run(trial, say)
    for one in broken:
        say(f"BROKEN {one}")
    say(f"{len(broken)} rules broken; the seed was {seed}")
    sys.exit(1 if broken else 0)


if __name__ == "__main__":
    main()

"""What a worker loads before it takes its first job: what most jobs need, and nothing that takes seconds for a few."""

import subprocess
import sys

LOADING = """
import sys
from marey_schemas.job_kinds import job_kinds
from marey_worker.child import load
load(list(job_kinds()))
print(*(name for name in ("scipy.stats", "scipy.signal", "sklearn", "matplotlib") if name in sys.modules))
"""


def test_a_worker_waits_for_no_statistics_and_no_drawing_before_its_first_job():
    told = subprocess.run([sys.executable, "-c", LOADING], capture_output=True, text=True, check=True)
    assert (told.stdout.strip(), told.stderr) == ("", "")

"""Modules that a worker loads before its first job."""

import subprocess
import sys

LOADING = """
import sys
from marey_schemas.queue.job_kinds import job_kinds
from marey_worker.child import load
load(list(job_kinds()))
avoided = ("scipy.ndimage", "scipy.stats", "scipy.signal", "sklearn", "matplotlib")
print(*(name for name in avoided if name in sys.modules))
"""


def test_a_worker_waits_for_no_statistics_and_no_drawing_before_its_first_job() -> None:
    told = subprocess.run([sys.executable, "-c", LOADING], capture_output=True, text=True, check=True)
    assert (told.stdout.strip(), told.stderr) == ("", "")


COLLECTING = """
import gc, importlib, sys, weakref
from marey_schemas.queue.job_kinds import job_kinds
from marey_worker.child import Garbage, load
class Thing: pass
def cycle():
    thing = Thing()
    thing.itself = thing
    return weakref.ref(thing)
load(list(job_kinds()))
garbage = Garbage()
searched = [len(gc.get_objects())]
left = [cycle()]
importlib.import_module("numba")
garbage.collect()
searched.append(len(gc.get_objects()))
left.append(cycle())
garbage.collect()
print(max(searched) < gc.get_freeze_count() / 20, *(one() for one in left))
"""


def test_garbage_of_jobs_is_freed_without_a_search_of_loaded_modules() -> None:
    told = subprocess.run([sys.executable, "-c", COLLECTING], capture_output=True, text=True, check=True)
    assert (told.stdout.split(), told.stderr) == (["True", "None", "None"], "")

"""Computing threads, which do not prevent a server from ending."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path

from tests.support.patience import PATIENCE_S

from marey_server.process.computing import ComputeThreads
from marey_server.store.database.lanes import Client

ENDLESS = """
import sys, time
from marey_server import app, commands
create = app.create_app
def create_computing(settings, database):
    made = create(settings, database)
    for _ in range(9):
        made.services.compute_threads.submit(time.sleep, 600)
    return made
app.create_app = create_computing
commands.serve(data=sys.argv[1], port=0, drain_s=1, local_workers=0, log_form="text")
"""


def test_a_server_that_is_told_to_stop_does_not_wait_for_computations(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ENDLESS, str(tmp_path)], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert any("listening" in line for line in process.stderr)
        process.send_signal(signal.SIGTERM)
        try:
            assert process.wait(120) == 0
        finally:
            process.kill()


def test_bodies_of_one_client_leave_a_thread_to_others() -> None:
    threads, release = ComputeThreads(2), threading.Event()
    held = [threads.submit_for(Client("anna"), release.wait, PATIENCE_S) for _ in range(2)]
    assert threads.submit_for(Client("ben"), lambda: "decoded").result(PATIENCE_S) == "decoded"
    release.set()
    assert all(call.result(PATIENCE_S) for call in held)
    threads.close()

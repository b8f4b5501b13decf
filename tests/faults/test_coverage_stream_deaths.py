"""A server that is killed during a recording: every frame counts once, and a kill does not change the coverage."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.support.server_process import ServerProcess
from tests.support.tiers import is_soak

from marey_motion.evaluation.online import OnlineCoverage
from marey_schemas.access import ProjectCreate
from marey_schemas.coverage_streams import CoverageProgress

pytestmark = pytest.mark.timeout(900)

RATE_HZ = 60.0
CHUNK = 12
DEATHS = 3
SECONDS, BETWEEN_DEATHS = (30.0, 20) if is_soak() else (8.0, 10)
"""Duration of the recording, and number of answers before each death."""


@pytest.fixture
def server(tmp_path: Path, database_url: str) -> Iterator[ServerProcess]:
    process = ServerProcess(tmp_path, database_url)
    yield process
    process.stop()


def performance(seconds: float) -> np.ndarray:
    """Return x, z (m) and heading (rad) of a body for each frame, (n, 3). Speed and turn rate grow with time."""
    times = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    headings = math.radians(40.0) * np.sin(0.3 * times) * times / 5.0
    steps = (1.0 + 0.05 * times)[:, None] / RATE_HZ * np.stack((np.sin(headings), np.cos(headings)), axis=-1)
    return np.column_stack((np.cumsum(steps, axis=0), headings))


def test_frames_sent_while_the_server_is_killed_count_once_each(server: ServerProcess) -> None:
    server.start()
    marey = server.client()
    marey.create_project(ProjectCreate(name="lab"))
    stream = marey.project("lab").coverage_streams.begin(RATE_HZ)
    roots = performance(SECONDS)
    answers: list[CoverageProgress] = []

    def perform() -> None:
        for start in range(0, len(roots), CHUNK):
            answers.append(stream.send(roots[start : start + CHUNK]))
            time.sleep(0.02)
        answers.append(stream.end_take())

    performer = threading.Thread(target=perform)
    performer.start()
    for death in range(DEATHS):
        while len(answers) < BETWEEN_DEATHS * (death + 1):
            assert performer.is_alive()
            time.sleep(0.001)
        server.kill()
        server.start()
    performer.join(120)
    assert not performer.is_alive()

    undisturbed = OnlineCoverage(RATE_HZ)
    windows = undisturbed.add_roots(roots[:, :2], roots[:, 2])
    rest = undisturbed.end_take()
    assert [answer.offset for answer in answers[:-1]] == list(range(CHUNK, len(roots) + 1, CHUNK))
    assert sum(answer.windows for answer in answers) == len(windows.speed_m_s) + len(rest.speed_m_s)
    state = stream.read()
    assert state.offset == len(roots)
    assert np.array(state.seconds).tolist() == undisturbed.seconds.tolist()
    assert 0.0 < state.index < 1.0
    server.check_database()

"""Free space of the data folder's disk: nothing is stored below a minimum, and a reserve lets a full server start."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from marey_server.errors import StorageFullProblem
from marey_server.process import disk_space
from marey_server.process.data_folder import prepare_data_folder
from marey_server.process.disk_space import RESERVE_BYTES, RESERVE_FILE, DiskSpace, free_bytes
from marey_server.process.settings import Settings

FLOOR_BYTES = 64 * 2**20
SetFree = Callable[[int], None]


@pytest.fixture
def set_free(monkeypatch: pytest.MonkeyPatch) -> SetFree:
    """Function that simulates a disk with a number of free bytes, in addition to the reserve."""

    def set_bytes(free: int) -> None:
        def usage(folder: Path) -> SimpleNamespace:
            return SimpleNamespace(free=free + (0 if (folder / RESERVE_FILE).exists() else RESERVE_BYTES))

        monkeypatch.setattr(shutil, "disk_usage", usage)

    monkeypatch.setattr(disk_space, "LOOK_AGAIN_S", 0)
    return set_bytes


def test_below_the_floor_nothing_is_stored_and_above_it_again(tmp_path: Path, set_free: SetFree) -> None:
    disk = DiskSpace(tmp_path, FLOOR_BYTES)
    (tmp_path / RESERVE_FILE).touch()
    set_free(FLOOR_BYTES - 1)
    with pytest.raises(StorageFullProblem):
        disk.require()
    assert "min_free_bytes" in str(disk.fault())
    set_free(FLOOR_BYTES)
    disk.require()
    assert disk.fault() is None


def test_a_start_on_a_full_disk_removes_the_reserve_and_one_with_space_makes_it(
    tmp_path: Path, set_free: SetFree
) -> None:
    reserve, settings = tmp_path / "data" / RESERVE_FILE, Settings(data=tmp_path / "data")
    set_free(100 * RESERVE_BYTES)
    prepare_data_folder(settings)
    assert (reserve.stat().st_size, reserve.stat().st_mode & 0o077) == (RESERVE_BYTES, 0)
    set_free(RESERVE_BYTES)
    prepare_data_folder(settings)
    assert reserve.exists()
    set_free(0)
    prepare_data_folder(settings)
    assert not reserve.exists()
    assert free_bytes(settings.data) == RESERVE_BYTES

"""Exports to LeRobotDataset v3.0, read as the specification of the format says, with only pyarrow and numpy."""

from __future__ import annotations

import json
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from tests.support.version_in_memory import VersionInMemory, tree

from marey_client.bridges import episodes, lerobot
from marey_client.bridges.lerobot import write_lerobot
from marey_client.bridges.parquet import FilePlace, ParquetFiles
from marey_client.errors import CannotExport, FolderNotEmpty
from marey_motion.clip import Clip
from marey_motion.formats import read_motion
from marey_motion.gait import generate_gait
from marey_schemas.datasets.exports import ExportedFolder, ExportedRecord

SPEEDS = (0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0)


def silent(_what: str, _done: int, _total: int | None) -> None:
    pass


@pytest.fixture
def gaits() -> VersionInMemory:
    motions = {
        f"walks/{speed}": generate_gait(speed, 0.1 * place, 0.5 + 0.1 * place) for place, speed in enumerate(SPEEDS)
    }
    records = {
        "walks/1.0": ExportedRecord(action="stroll", licence="CC0"),
        "walks/1.4": ExportedRecord(action="hurry"),
        "walks/2.0": ExportedRecord(action="stroll"),
    }
    return VersionInMemory.of(motions, records)


class Reading:
    """Independent reader of a LeRobotDataset. Paths follow the templates in `meta/info.json`; pyarrow reads rows."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.info = json.loads((root / "meta/info.json").read_text("utf-8"))
        self.stats = json.loads((root / "meta/stats.json").read_text("utf-8"))
        self.tasks = parquet.read_table(root / "meta/tasks.parquet")
        found = sorted((root / "meta/episodes").glob("*/*.parquet"))
        self.episodes = [row for path in found for row in parquet.read_table(path).to_pylist()]
        self.files = sorted((root / "data").glob("*/*.parquet"))
        self.data = pa.concat_tables([parquet.read_table(path) for path in self.files])

    def column(self, name: str) -> np.ndarray[Any, Any]:
        rows = self.data.column(name).combine_chunks()
        if pa.types.is_fixed_size_list(rows.type):
            return rows.flatten().to_numpy().reshape(len(rows), rows.type.list_size)
        return rows.to_numpy()

    def rows_of(self, episode: dict[str, Any]) -> list[dict[str, Any]]:
        """Return the rows of an episode from the file that the table of episodes names, as LeRobot does."""
        chunk, file = episode["data/chunk_index"], episode["data/file_index"]
        path = self.root / self.info["data_path"].format(chunk_index=chunk, file_index=file)
        rows = parquet.read_table(path, filters=[("episode_index", "=", episode["episode_index"])])
        found: list[dict[str, Any]] = rows.to_pylist()
        return found


def check_specification(read: Reading) -> None:
    """Check everything that holds for all datasets of this version of the format."""
    info = read.info
    assert info["codebase_version"] == "v3.0"
    assert (info["chunks_size"], info["video_path"]) == (1000, None)
    assert info["splits"] == {"train": f"0:{info['total_episodes']}"}
    arrow = {"float32": pa.float32(), "int64": pa.int64()}
    assert set(read.data.column_names) == set(info["features"])
    for name, feature in info["features"].items():
        kind, (width,) = read.data.schema.field(name).type, feature["shape"]
        if name in ("observation.state", "action"):
            assert kind == pa.list_(arrow[feature["dtype"]], width)
            assert len(feature["names"]) == len(set(feature["names"])) == width
        else:
            assert (kind, width, feature["names"]) == (arrow[feature["dtype"]], 1, None)
    assert [row["episode_index"] for row in read.episodes] == list(range(info["total_episodes"]))
    assert len(read.data) == info["total_frames"] == sum(row["length"] for row in read.episodes)
    assert np.array_equal(read.column("index"), np.arange(info["total_frames"]))
    start = 0
    tasks = dict(zip(read.tasks["task"].to_pylist(), read.tasks["task_index"].to_pylist(), strict=True))
    assert sorted(tasks.values()) == list(range(info["total_tasks"]))
    for row in read.episodes:
        rows, length = read.rows_of(row), row["length"]
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (start, start + length)
        assert [one["index"] for one in rows] == list(range(start, start + length))
        assert [one["frame_index"] for one in rows] == list(range(length))
        assert {one["task_index"] for one in rows} == {tasks[task] for task in row["tasks"]}
        times = np.array([one["timestamp"] for one in rows])
        assert np.allclose(times, np.arange(length) / info["fps"], atol=1e-4)
        states = [one["observation.state"] for one in rows]
        assert [one["action"] for one in rows] == [*states[1:], states[-1]]
        start += length
    columns = {name: read.column(name).astype(np.float64).reshape(start, -1) for name in info["features"]}
    check_statistics(columns, read.stats)
    for row in read.episodes:
        inside = slice(row["dataset_from_index"], row["dataset_to_index"])
        named = {name: {key: row[f"stats/{name}/{key}"] for key in read.stats[name]} for name in columns}
        check_statistics({name: rows[inside] for name, rows in columns.items()}, named)


def check_statistics(columns: dict[str, np.ndarray[Any, Any]], found: dict[str, dict[str, list[float]]]) -> None:
    assert found.keys() == columns.keys()
    for name, rows in columns.items():
        assert found[name]["count"] == [len(rows)]
        assert found[name]["min"] == rows.min(axis=0).tolist()
        assert found[name]["max"] == rows.max(axis=0).tolist()
        assert np.allclose(found[name]["mean"], rows.mean(axis=0), rtol=1e-9, atol=1e-12)
        assert np.allclose(found[name]["std"], rows.std(axis=0), rtol=1e-7, atol=1e-9)


def test_generated_gaits_are_episodes_of_the_specification(gaits: VersionInMemory, tmp_path: Path) -> None:
    made = write_lerobot(gaits, tmp_path / "out", silent)
    read = Reading(tmp_path / "out")
    check_specification(read)
    assert made.clips == read.info["total_episodes"] == len(SPEEDS)
    assert [one["tasks"] for one in read.episodes] == [
        [task] for task in ("motion", "stroll", "motion", "hurry", "motion", "motion", "stroll")
    ]
    for row, (path, motion) in zip(read.episodes, sorted(gaits.motions.items()), strict=True):
        states = np.array([one["observation.state"] for one in read.rows_of(row)])
        assert np.allclose(states[:, :3], motion.root_translations, atol=1e-6), path
        assert np.allclose(states[:, 3:].reshape(len(states), -1, 4), motion.rotations, atol=1e-6), path
    names = read.info["features"]["observation.state"]["names"]
    assert names[:4] == ["root.position.x", "root.position.y", "root.position.z", "Hips.rotation.w"]
    assert len(names) == 3 + 4 * motion.rotations.shape[1]


def test_the_identity_is_in_the_sidecar_and_in_the_info(gaits: VersionInMemory, tmp_path: Path) -> None:
    write_lerobot(gaits, tmp_path / "out", silent)
    home = Reading(tmp_path / "out").info["marey"]
    assert (home["dataset"], home["commit"], home["tag"]) == ("gaits", gaits.commit.digest, "v1")
    assert (home["licences"], home["lineage"]) == (["CC0"], [{"job": None, "clips": len(SPEEDS)}])
    sidecar = ExportedFolder.model_validate_json((tmp_path / "out/marey.json").read_bytes())
    assert [(one.path, one.episode) for one in sidecar.clips] == [(f"walks/{v}", n) for n, v in enumerate(SPEEDS)]
    assert (sidecar.layout, sidecar.commit, sidecar.licences) == ("lerobot", gaits.commit.digest, ("CC0",))


def test_the_same_version_gives_the_same_bytes(gaits: VersionInMemory, tmp_path: Path) -> None:
    for name in ("first", "second"):
        write_lerobot(gaits, tmp_path / name, silent)
    assert tree(tmp_path / "first") == tree(tmp_path / "second")


def test_files_of_limited_size_hold_many_episodes(
    gaits: VersionInMemory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot, "ParquetFiles", lambda folder: ParquetFiles(folder, most_bytes=200_000))
    monkeypatch.setattr(episodes, "EPISODES_PER_GROUP", 2)
    write_lerobot(gaits, tmp_path / "out", silent)
    read = Reading(tmp_path / "out")
    check_specification(read)
    assert 1 < len(read.files) < len(SPEEDS)
    assert [path.name for path in read.files] == [f"file-{number:03d}.parquet" for number in range(len(read.files))]
    groups = [parquet.ParquetFile(path).metadata for path in read.files]
    for metadata in groups:
        sizes = [metadata.row_group(place).total_byte_size for place in range(metadata.num_row_groups)]
        assert len(sizes) == 1 or sum(sizes) <= 200_000
    assert sum(metadata.num_row_groups for metadata in groups) == len(SPEEDS)
    for row in read.episodes:
        path = f"meta/episodes/chunk-{row['meta/episodes/chunk_index']:03d}/file-{row['meta/episodes/file_index']:03d}"
        assert (
            row["episode_index"]
            in parquet.read_table(tmp_path / "out" / f"{path}.parquet")["episode_index"].to_pylist()
        )


def test_a_chunk_has_at_most_a_thousand_files() -> None:
    assert FilePlace(0, 998).following == FilePlace(0, 999)
    assert FilePlace(0, 999).following == FilePlace(1, 0)
    assert FilePlace(12, 3).name == "chunk-012/file-003.parquet"


def slower(motion: Clip, rate_hz: float) -> Clip:
    return replace(motion, frame_rate_hz=rate_hz)


def test_another_frame_rate_is_refused_with_the_clips_that_have_it(gaits: VersionInMemory, tmp_path: Path) -> None:
    motions = dict(gaits.motions)
    rate = motions["walks/0.8"].frame_rate_hz
    motions |= {name: slower(motions[name], rate / 2) for name in ("walks/1.0", "walks/1.2")}
    with pytest.raises(CannotExport, match=rf"walks/0\.8 .*: walks/1\.0 \({rate / 2:g} Hz\), walks/1\.2 .*resample"):
        write_lerobot(VersionInMemory.of(motions), tmp_path / "out", silent)
    assert list(tmp_path.iterdir()) == []


def test_rates_that_differ_by_rounding_count_as_equal(gaits: VersionInMemory, tmp_path: Path) -> None:
    rate = gaits.motions["walks/0.8"].frame_rate_hz
    motions = {name: slower(one, rate * (1 + 4e-5)) for name, one in gaits.motions.items()}
    motions["walks/1.2"] = gaits.motions["walks/1.2"]
    write_lerobot(VersionInMemory.of(motions), tmp_path / "out", silent)
    assert Reading(tmp_path / "out").info["fps"] == round(rate)


def test_another_skeleton_is_refused(gaits: VersionInMemory, mocap: Path, tmp_path: Path) -> None:
    other = real_clips(mocap)["cmu/01_01"]
    motions = {**gaits.motions, "other": other}
    with pytest.raises(CannotExport, match=r"walks/0\.8 \(another skeleton\).*retarget"):
        write_lerobot(VersionInMemory.of(motions), tmp_path / "out", silent)


def real_clips(mocap: Path) -> dict[str, Clip]:
    found = {}
    for name in ("01_01", "10_01", "10_03"):
        motion = read_motion((mocap / f"cmu-bvh/{name}.bvh").read_bytes(), f"{name}.bvh")
        assert motion.clip is not None
        found[f"cmu/{name}"] = motion.clip
    return found


def test_real_takes_are_episodes_of_the_specification(mocap: Path, tmp_path: Path) -> None:
    takes = {name: clip for name, clip in real_clips(mocap).items() if name != "cmu/01_01"}
    write_lerobot(VersionInMemory.of(takes), tmp_path / "out", silent)
    read = Reading(tmp_path / "out")
    check_specification(read)
    assert [one["length"] for one in read.episodes] == [clip.frame_count for clip in takes.values()]
    assert read.info["fps"] == 120


def test_an_interrupted_export_leaves_nothing(gaits: VersionInMemory, tmp_path: Path) -> None:
    def interrupt(_what: str, done: int, _total: int | None) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_lerobot(gaits, tmp_path / "out", interrupt)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_content_is_not_touched(gaits: VersionInMemory, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine.txt").write_text("mine")
    with pytest.raises(FolderNotEmpty, match="not empty"):
        write_lerobot(gaits, tmp_path / "out", silent)
    assert tree(tmp_path) == {"out/mine.txt": b"mine"}


def test_without_pyarrow_the_error_names_the_command_that_installs_it() -> None:
    code = (
        "import sys; sys.modules['pyarrow'] = None\n"
        "from marey_client.bridges.parquet import import_pyarrow\n"
        "from marey_client.errors import MissingPackage\n"
        "try: import_pyarrow()\n"
        "except MissingPackage as error: print(error)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "pip install 'marey[bridges]'" in told


def test_memory_does_not_grow_with_the_number_of_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episodes, "EPISODES_PER_GROUP", 2)
    walk = generate_gait(1.2, 0.0, 4.0)
    peaks = []
    for count in (6, 24):
        version = VersionInMemory.of({f"w{place:02d}": walk for place in range(count)})
        tracemalloc.start()
        write_lerobot(version, tmp_path / str(count), silent)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]

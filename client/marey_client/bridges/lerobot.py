"""Export of a version as a LeRobotDataset v3.0: one episode for each clip, many episodes in each file.

A state is the root's position in metres, then the local rotation of each joint as a quaternion w, x, y, z, then the
position of each joint that has one. The action of a frame is the state of the next frame; that of the last frame is its
own state.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from marey_client.bridges.files import ExportedVersion
from marey_client.bridges.folders import new_folder
from marey_client.bridges.parquet import (
    COMPRESSION,
    MOST_FILE_MB,
    MOST_FILES_PER_CHUNK,
    FilePlace,
    ParquetFiles,
    import_pyarrow,
)
from marey_client.bridges.sidecars import SidecarWriter
from marey_client.bridges.statistics import ColumnStatistics
from marey_client.bridges.version import REQUESTS_AT_ONCE, DescribedClip, VersionToExport
from marey_client.errors import CannotExport

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from marey_client.archives import OnProgress

CODEBASE_VERSION = "v3.0"
STATE, ACTION = "observation.state", "action"
_COUNTERS = ("frame_index", "episode_index", "index", "task_index")
NO_ACTION = "motion"
"""Task of the clips whose take record names no action."""
RATE_TOLERANCE = 1e-4
"""Greatest relative difference of frame rates that count as equal; files state them with few digits."""
EPISODES_PER_GROUP = 100
"""Number of episodes that are written to the table of episodes at once."""
NAMES_SHOWN = 10


class Rig(NamedTuple):
    """Facts in which all clips of a LeRobotDataset must agree."""

    hierarchy: str
    """Content digest of the skeleton's hierarchy."""
    joints: tuple[str, ...]
    translated: tuple[str, ...]
    """Joints with positions of their own."""
    rate_hz: float

    @property
    def names(self) -> list[str]:
        """The names of the numbers of a state, in order."""
        return [
            *(f"root.position.{axis}" for axis in "xyz"),
            *(f"{joint}.rotation.{axis}" for joint in self.joints for axis in "wxyz"),
            *(f"{joint}.position.{axis}" for joint in self.translated for axis in "xyz"),
        ]

    @property
    def fps(self) -> int | float:
        """The frame rate in hertz, as a whole number if it is one but for rounding."""
        whole = round(self.rate_hz)
        return whole if math.isclose(self.rate_hz, whole, rel_tol=RATE_TOLERANCE) else self.rate_hz

    def difference_to(self, other: Rig) -> str | None:
        """Return what differs in another rig, in words; None if nothing does."""
        if (self.hierarchy, self.joints) != (other.hierarchy, other.joints):
            return "another skeleton"
        if self.translated != other.translated:
            return "other joints with positions"
        if not math.isclose(self.rate_hz, other.rate_hz, rel_tol=RATE_TOLERANCE):
            return f"{other.rate_hz:g} Hz"
        return None


class _Episode(NamedTuple):
    """Rows of one clip."""

    state: NDArray[np.float32]
    columns: Mapping[str, NDArray[Any]]
    """All columns, by name."""


def write_lerobot(version: VersionToExport, target: Path, on_progress: OnProgress) -> ExportedVersion:
    """Write a version to a new folder as a LeRobotDataset.

    Raises `CannotExport` if the clips do not have the same skeleton and frame rate, and `MissingPackage` if pyarrow is
    not installed.
    """
    import_pyarrow()
    identity = version.identity.model_dump(mode="json", exclude_none=True)
    with new_folder(target) as folder:
        with (
            SidecarWriter(folder, {**identity, "layout": "lerobot"}) as sidecar,
            ParquetFiles(folder / "data") as data,
            ParquetFiles(folder / "meta" / "episodes") as episodes,
            ThreadPoolExecutor(REQUESTS_AT_ONCE, thread_name_prefix="marey-export") as pool,
        ):
            writing = _Writing(version, sidecar, data, _EpisodeTable(episodes))
            for group in version.described(pool):
                writing.add_group(group, on_progress)
            writing.episodes.flush()
            sidecar.finish()
        writing.write_summary(folder / "meta", {**identity, "licences": sidecar.licences})
    return ExportedVersion(version.commit, target, len(version.clips), {}, version.left_out)


@dataclass
class _Writing:
    """LeRobotDataset that is being written."""

    version: VersionToExport
    sidecar: SidecarWriter
    data: ParquetFiles
    episodes: _EpisodeTable
    rig: Rig | None = None
    first: str = ""
    """Path of the first clip, with which the others are compared."""
    hierarchies: dict[str, str] = field(default_factory=dict)
    """Content digest of the hierarchy of each skeleton, by the content digest of the skeleton's revision."""
    tasks: dict[str, int] = field(default_factory=dict)
    made: Counter[tuple[str, tuple[str, ...]]] = field(default_factory=Counter)
    """Number of clips by the kind of the job that made them and the commits of its inputs."""
    statistics: dict[str, ColumnStatistics] = field(default_factory=dict)
    frames: int = 0
    done: int = 0

    def add_group(self, group: Sequence[DescribedClip], on_progress: OnProgress) -> None:
        """Add clips as episodes. Raises `CannotExport` with the clips that differ from the first one."""
        differing: list[str] = []
        motions = self.version.documents([one.entry for one in group], "motion")
        for one, motion in zip(group, motions, strict=True):
            rig = self._rig_of(motion)
            if self.rig is None:
                self.rig, self.first = rig, one.clip.path
            difference = self.rig.difference_to(rig)
            if difference is not None:
                differing.append(f"{one.clip.path} ({difference})")
            elif not differing:
                self._add(one, motion)
                on_progress("writing episodes", self.done, len(self.version.clips))
        if differing:
            raise CannotExport(self._refusal(differing))

    def _refusal(self, differing: Sequence[str]) -> str:
        assert self.rig is not None
        shown = ", ".join(differing[:NAMES_SHOWN])
        more = f" and {len(differing) - NAMES_SHOWN} more" if len(differing) > NAMES_SHOWN else ""
        return (
            "all clips of a LeRobotDataset need the same skeleton and frame rate, but these differ from "
            f"{self.first} ({self.rig.rate_hz:g} Hz): {shown}{more}; retarget clips with another skeleton (marey "
            "retarget), resample clips with another frame rate (marey edit), commit the results, and export them"
        )

    def _rig_of(self, motion: Mapping[str, Any]) -> Rig:
        skeleton = motion["skeleton"]["content"]
        if skeleton not in self.hierarchies:
            self.hierarchies[skeleton] = self.version.parts_of(skeleton)["hierarchy"]
        joints, translated = motion["joints"], motion.get("translated_joints", ())
        return Rig(self.hierarchies[skeleton], tuple(joints), tuple(translated), float(motion["frame_rate_hz"]))

    def _add(self, one: DescribedClip, motion: Mapping[str, Any]) -> None:
        assert self.rig is not None
        task = (one.clip.record.action or "").strip() or NO_ACTION
        number = self.tasks.setdefault(task, len(self.tasks))
        episode = _episode(motion, self.rig.fps, self.done, self.frames, number)
        length = len(episode.state)
        place = self.data.add(_data_table(episode))
        statistics = {name: ColumnStatistics.of(rows) for name, rows in episode.columns.items()}
        self.episodes.add(self.done, task, self.frames, length, place, statistics)
        for name, new in statistics.items():
            self.statistics[name] = reduce(ColumnStatistics.merged, [*self._known(name), new])
        self.sidecar.add(one.clip.model_copy(update={"episode": self.done}))
        if one.clip.job is not None:
            self.made[one.clip.job.kind, one.clip.job.commits] += 1
        self.frames += length
        self.done += 1

    def _known(self, name: str) -> list[ColumnStatistics]:
        return [self.statistics[name]] if name in self.statistics else []

    def write_summary(self, meta: Path, identity: Mapping[str, Any]) -> None:
        """Write the description of the whole, the statistics, and the table of tasks."""
        assert self.rig is not None
        lineage = [
            {"job": kind, "commits": commits, "clips": count} for (kind, commits), count in sorted(self.made.items())
        ]
        home = {
            **identity,
            "units": "metres; quaternions w, x, y, z; right-handed axes with Y up",
            "skeleton": self.rig.hierarchy,
            "lineage": [*lineage, {"job": None, "clips": self.done - self.made.total()}],
        }
        info = {**_info(self.rig), "total_episodes": self.done, "total_frames": self.frames}
        info |= {"total_tasks": len(self.tasks), "splits": {"train": f"0:{self.done}"}, "marey": home}
        _write_json(meta / "info.json", info)
        _write_json(meta / "stats.json", {name: one.document for name, one in self.statistics.items()})
        _write_tasks(meta / "tasks.parquet", self.tasks)


class _EpisodeTable:
    """Table of episodes, written in groups of rows."""

    def __init__(self, files: ParquetFiles) -> None:
        self._files = files
        self._rows: list[dict[str, Any]] = []

    def add(
        self,
        number: int,
        task: str,
        start: int,
        length: int,
        place: FilePlace,
        statistics: Mapping[str, ColumnStatistics],
    ) -> None:
        """Add the episode whose frames begin at the index `start` of the whole, in the data file at `place`."""
        row: dict[str, Any] = {
            "episode_index": number, "tasks": [task], "length": length,
            "data/chunk_index": place.chunk, "data/file_index": place.file,
            "dataset_from_index": start, "dataset_to_index": start + length,
        }  # fmt: skip
        for name, one in statistics.items():
            row |= {f"stats/{name}/{key}": values for key, values in one.document.items()}
        self._rows.append(row)
        if len(self._rows) == EPISODES_PER_GROUP:
            self.flush()

    def flush(self) -> None:
        """Write the rows that are still in memory."""
        if not self._rows:
            return
        place = self._files.place_for(self._table(FilePlace(0, 0)).nbytes)
        self._files.add(self._table(place))
        self._rows.clear()

    def _table(self, place: FilePlace) -> pa.Table:
        pyarrow = import_pyarrow()
        own = {"meta/episodes/chunk_index": place.chunk, "meta/episodes/file_index": place.file}
        rows = [{**row, **own} for row in self._rows]
        kinds = {"tasks": pyarrow.list_(pyarrow.string())}
        for name in rows[0]:
            if name.startswith("stats/"):
                number = pyarrow.int64() if name.endswith("/count") else pyarrow.float64()
                kinds[name] = pyarrow.list_(number)
        schema = pyarrow.schema([(name, kinds.get(name, pyarrow.int64())) for name in rows[0]])
        return pyarrow.Table.from_pylist(rows, schema=schema)


def _episode(motion: Mapping[str, Any], fps: float, number: int, start: int, task: int) -> _Episode:
    """Return the rows of a clip: episode `number`, whose first frame has the index `start` in the whole."""
    poses = np.asarray(motion["poses"], dtype=np.float32)
    length = len(poses)
    moved = motion.get("translations")
    parts = [poses] if moved is None else [poses, np.asarray(moved, dtype=np.float32).reshape(length, -1)]
    state = np.ascontiguousarray(np.concatenate(parts, axis=1))
    frames = np.arange(length, dtype=np.int64)
    columns = {
        STATE: state,
        ACTION: np.concatenate([state[1:], state[-1:]]),
        "timestamp": (frames / fps).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full(length, number, dtype=np.int64),
        "index": start + frames,
        "task_index": np.full(length, task, dtype=np.int64),
    }
    return _Episode(state, columns)


def _data_table(episode: _Episode) -> pa.Table:
    pyarrow = import_pyarrow()
    columns = {}
    for name, rows in episode.columns.items():
        numbers = pyarrow.array(rows.reshape(-1))
        columns[name] = numbers if rows.ndim == 1 else pyarrow.FixedSizeListArray.from_arrays(numbers, rows.shape[1])
    return pyarrow.table(columns)


def _info(rig: Rig) -> dict[str, Any]:
    names = rig.names
    vector = {"dtype": "float32", "shape": [len(names)], "names": names}
    single = {"shape": [1], "names": None}
    return {
        "codebase_version": CODEBASE_VERSION,
        "robot_type": None,
        "total_episodes": 0,
        "total_frames": 0,
        "total_tasks": 0,
        "chunks_size": MOST_FILES_PER_CHUNK,
        "data_files_size_in_mb": MOST_FILE_MB,
        "video_files_size_in_mb": MOST_FILE_MB,
        "fps": rig.fps,
        "splits": {},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {
            STATE: vector,
            ACTION: vector,
            "timestamp": {"dtype": "float32", **single},
            **{name: {"dtype": "int64", **single} for name in _COUNTERS},
        },
    }


def _write_tasks(path: Path, tasks: Mapping[str, int]) -> None:
    """Write the table of tasks, whose index in pandas is the text of the task, as LeRobot reads it."""
    pyarrow = import_pyarrow()
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        for name, kind, numpy_type in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    described = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pyarrow.table({"task_index": pyarrow.array(list(tasks.values()), pyarrow.int64()), "task": list(tasks)})
    table = table.replace_schema_metadata({b"pandas": json.dumps(described).encode()})
    pyarrow.parquet.write_table(table, path, compression=COMPRESSION)


def _write_json(path: Path, document: Mapping[str, Any]) -> None:
    text = json.dumps(document, indent=4, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8", newline="\n")

"""Export of a version as a LeRobotDataset v3.0: one episode for each clip, many episodes in each file.

A state is the root's position in metres, then the local rotation of each joint as a quaternion w, x, y, z, then the
position of each joint that has a position in each frame. The action of a frame is the state of the next frame; the last
frame has its own state as action.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from marey_client.asynchronous.interruption import CallPool
from marey_client.bridges.episodes import (
    ACTION,
    COUNTERS,
    STATE,
    ColumnStatistics,
    EpisodeTable,
    data_table,
    episode_of,
)
from marey_client.bridges.files import ExportedVersion
from marey_client.bridges.folders import new_folder, require_free
from marey_client.bridges.parquet import (
    COMPRESSION,
    MOST_FILE_MB,
    MOST_FILES_PER_CHUNK,
    ParquetFiles,
    import_pyarrow,
)
from marey_client.bridges.sidecars import SidecarWriter
from marey_client.bridges.version import (
    EXPORTS_AT_ONCE,
    DatasetToExport,
    DescribedClip,
    VersionToExport,
    version_to_export,
)
from marey_client.errors import CannotExport
from marey_schemas.wording import listed

if TYPE_CHECKING:
    from marey_client.progress import OnProgress

CODEBASE_VERSION = "v3.0"
NO_ACTION = "motion"
"""Task (a text for each episode in LeRobot) of the clips whose take record names no action."""
RATE_TOLERANCE = 1e-4
"""Greatest relative difference of frame rates that count as equal, because files state rates with few digits."""


class CommonRig(NamedTuple):
    """Skeleton, translated joints and frame rate, which all clips of a LeRobotDataset must have in common."""

    hierarchy: str
    """Content digest of the skeleton's hierarchy."""
    joints: tuple[str, ...]
    translated: tuple[str, ...]
    """Joints that have a position in each frame, in addition to their rotation."""
    rate_hz: float

    @property
    def names(self) -> list[str]:
        """The names of the numbers that make up a state, in order."""
        return [
            *(f"root.position.{axis}" for axis in "xyz"),
            *(f"{joint}.rotation.{axis}" for joint in self.joints for axis in "wxyz"),
            *(f"{joint}.position.{axis}" for joint in self.translated for axis in "xyz"),
        ]

    @property
    def fps(self) -> int | float:
        """The frame rate in hertz, rounded to a whole number if the difference is within `RATE_TOLERANCE`."""
        whole = round(self.rate_hz)
        return whole if math.isclose(self.rate_hz, whole, rel_tol=RATE_TOLERANCE) else self.rate_hz

    def difference_to(self, other: CommonRig) -> str | None:
        """Return the first difference of `other` from this rig, as text; None if clips of both fit into one dataset."""
        if (self.hierarchy, self.joints) != (other.hierarchy, other.joints):
            return "another skeleton"
        if self.translated != other.translated:
            return "other joints with positions"
        if not math.isclose(self.rate_hz, other.rate_hz, rel_tol=RATE_TOLERANCE):
            return f"{other.rate_hz:g} Hz"
        return None


def prepare_lerobot(
    dataset: DatasetToExport,
    version: str,
    target: Path,
    *,
    path: str = "",
    allow_expired_consent: str | None = None,
) -> VersionToExport:
    """Check whether a version can be exported to LeRobot in the new folder `target`; read its entries below `path`.

    Raises `MissingPackage` if pyarrow is not installed; also the errors of `require_free` and `version_to_export`.
    """
    import_pyarrow()
    require_free(target)
    return version_to_export(dataset, version, path, allow_expired_consent=allow_expired_consent)


def write_lerobot(version: VersionToExport, target: Path, on_progress: OnProgress) -> ExportedVersion:
    """Write a version to a new folder as a LeRobotDataset.

    Raises `CannotExport` if the clips differ in skeleton, joints with positions or frame rate.
    """
    identity = version.identity.model_dump(mode="json", exclude_none=True)
    with new_folder(target) as folder:
        with (
            SidecarWriter(folder, {**identity, "layout": "lerobot"}) as sidecar,
            ParquetFiles(folder / "data") as data,
            ParquetFiles(folder / "meta" / "episodes") as episodes,
            CallPool(EXPORTS_AT_ONCE, thread_name_prefix="marey-export") as pool,
        ):
            writing = _Writing(version, sidecar, data, EpisodeTable(episodes))
            for group in version.described(pool):
                writing.add_group(group, on_progress)
            writing.episodes.flush()
            sidecar.finish()
        writing.write_summary(folder / "meta", {**identity, "licences": sidecar.licences})
    return ExportedVersion(version.commit, target, len(version.clips), {}, version.left_out)


@dataclass
class _Writing:
    """LeRobotDataset while it is written: its files, and what is known of the clips written so far."""

    version: VersionToExport
    sidecar: SidecarWriter
    data: ParquetFiles
    episodes: EpisodeTable
    rig: CommonRig | None = None
    first: str = ""
    """Path of the first clip, with which all other clips are compared."""
    hierarchies: dict[str, str] = field(default_factory=dict)
    """Content digest of the hierarchy of each skeleton, by the content digest of the skeleton's revision."""
    tasks: dict[str, int] = field(default_factory=dict)
    made: Counter[tuple[str, tuple[str, ...]]] = field(default_factory=Counter)
    """Number of clips by the job that made them: by the kind of the job, and by the commits of its inputs."""
    statistics: dict[str, ColumnStatistics] = field(default_factory=dict)
    frames: int = 0
    done: int = 0

    def add_group(self, group: Sequence[DescribedClip], on_progress: OnProgress) -> None:
        """Add clips as episodes. Raises `CannotExport` with the names of clips that differ from the first clip."""
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
        return (
            "all clips of a LeRobotDataset need the same skeleton, joints with positions and frame rate, but these "
            f"differ from {self.first} ({self.rig.rate_hz:g} Hz): {listed(differing)}; retarget clips with another "
            "skeleton or other joints with positions (marey retarget), resample clips with another frame rate (marey "
            "edit), commit the results, and export them"
        )

    def _rig_of(self, motion: Mapping[str, Any]) -> CommonRig:
        skeleton = motion["skeleton"]["content"]
        if skeleton not in self.hierarchies:
            self.hierarchies[skeleton] = self.version.parts_of(skeleton)["hierarchy"]
        joints, translated = motion["joints"], motion.get("translated_joints", ())
        return CommonRig(self.hierarchies[skeleton], tuple(joints), tuple(translated), float(motion["frame_rate_hz"]))

    def _add(self, one: DescribedClip, motion: Mapping[str, Any]) -> None:
        assert self.rig is not None
        task = (one.clip.record.action or "").strip() or NO_ACTION
        number = self.tasks.setdefault(task, len(self.tasks))
        episode = episode_of(motion, self.rig.fps, self.done, self.frames, number)
        length = len(episode.state)
        place = self.data.add(data_table(episode))
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
        """Write the files about the whole dataset: its description, the statistics, and the table of tasks."""
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


def _info(rig: CommonRig) -> dict[str, Any]:
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
            **{name: {"dtype": "int64", **single} for name in COUNTERS},
        },
    }


def _write_tasks(path: Path, tasks: Mapping[str, int]) -> None:
    """Write the table of tasks as LeRobot reads it: a pandas table whose index is the text of the task."""
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

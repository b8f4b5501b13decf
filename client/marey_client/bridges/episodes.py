"""Episodes of a LeRobotDataset: their rows, their statistics, and the table that lists them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from marey_client.bridges.parquet import FilePlace, ParquetFiles, import_pyarrow

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

STATE, ACTION = "observation.state", "action"
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
EPISODES_PER_GROUP = 100
"""Number of rows (one for each episode) that are collected before they are written to the table of episodes."""


@dataclass(frozen=True)
class ColumnStatistics:
    """Statistics of a table: the number of rows and, for each column, extremes, mean and summed squared deviations."""

    count: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    mean: NDArray[np.float64]
    squares: NDArray[np.float64]

    @classmethod
    def of(cls, rows: NDArray[np.generic]) -> Self:
        """Return the statistics of an array (rows, columns); an array with one dimension counts as one column."""
        values = np.asarray(rows, dtype=np.float64).reshape(len(rows), -1)
        mean = values.mean(axis=0)
        squares = np.square(values - mean).sum(axis=0)
        return cls(len(values), values.min(axis=0), values.max(axis=0), mean, squares)

    def merged(self, other: ColumnStatistics) -> ColumnStatistics:
        """Return the statistics of all rows of this object and `other` (method of Chan, Golub and LeVeque, 1979)."""
        count = self.count + other.count
        shift = other.mean - self.mean
        return ColumnStatistics(
            count,
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
            self.mean + shift * (other.count / count),
            self.squares + other.squares + np.square(shift) * (self.count * other.count / count),
        )

    @property
    def document(self) -> dict[str, list[float] | list[int]]:
        """The statistics as LeRobot stores them; `std` is the population standard deviation (divisor n)."""
        return {
            "min": self.low.tolist(),
            "max": self.high.tolist(),
            "mean": self.mean.tolist(),
            "std": np.sqrt(self.squares / self.count).tolist(),
            "count": [self.count],
        }


class Episode(NamedTuple):
    """One clip as an episode of a LeRobotDataset: a row for each frame."""

    state: NDArray[np.float32]
    columns: Mapping[str, NDArray[Any]]
    """All columns by name, each with a row for each frame; `state` is one of them."""


class EpisodeTable:
    """Writer of the table that lists the episodes of a LeRobotDataset, one row for each; it writes groups of rows."""

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
        """Add a row for an episode.

        The frames of the episode are in the data file `place` and begin at the index `start` of the dataset.
        """
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
        """Write the collected rows to the table; needed after the last episode."""
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


def episode_of(motion: Mapping[str, Any], fps: float, number: int, start: int, task: int) -> Episode:
    """Return a clip as the episode `number`; its first frame has the index `start` among all frames of the dataset."""
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
    return Episode(state, columns)


def data_table(episode: Episode) -> pa.Table:
    """Return an episode as a pyarrow table with a row for each frame; a vector becomes a list of fixed size."""
    pyarrow = import_pyarrow()
    columns = {}
    for name, rows in episode.columns.items():
        numbers = pyarrow.array(rows.reshape(-1))
        columns[name] = numbers if rows.ndim == 1 else pyarrow.FixedSizeListArray.from_arrays(numbers, rows.shape[1])
    return pyarrow.table(columns)

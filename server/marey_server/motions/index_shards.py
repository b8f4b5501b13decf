"""Shards of indexes of motions, which a child process keeps in memory between searches."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ValidationError

from marey_schemas.documents.motion_indexes import ShardClips
from marey_schemas.lru import LruCache
from marey_schemas.processes.limits import allow_mapped_files
from marey_schemas.sizes import GIB, MIB
from marey_server.errors import NotFoundProblem
from marey_server.motions.child import Message

if TYPE_CHECKING:  # numeric modules are loaded by children alone
    from marey_motion.similarity.shards import Shard

MOST_MAPPED_BYTES = 4 * GIB
"""Greatest size of the files that a child process keeps mapped: those of an index of 200,000 s of motion."""
_LISTS_CACHE_BYTES = 64 * MIB


class ShardFiles(Message):
    """Paths of the local files of a shard: the list of its clips, and the features of their poses.

    `dropped` contains the positions in the list of the clips that no longer belong to the index.
    """

    clips: str
    poses: str
    dropped: tuple[int, ...]


class ListedShard:
    """List of the clips of a shard, with values that are computed once for all searches."""

    def __init__(self, clips: ShardClips) -> None:
        import numpy as np

        from marey_motion.similarity.shards import Runs

        self.clips = clips
        self.runs, self.joints = Runs.of(np.array(clips.rows, np.int64)), np.array(clips.joints, np.int64)
        self.places: dict[str, list[int]] = {}
        """Positions of each clip in the list."""
        for place, item in enumerate(clips.items):
            self.places.setdefault(item, []).append(place)

    @classmethod
    def read(cls, path: str) -> ListedShard:
        """Read the list from a file. Raises `ValidationError` if it is damaged."""
        return cls(ShardClips.model_validate_json(Path(path).read_bytes()))


_LISTS: LruCache[str, ListedShard] = LruCache(
    max_bytes=_LISTS_CACHE_BYTES, size_of=lambda shard: 600 * len(shard.clips.items)
)
"""Cache of a child process: lists of clips by the path of their file, which never changes."""


def list_of(files: ShardFiles) -> ListedShard:
    """Read the list of clips of a shard, which may come from any user. Raises `NotFoundProblem` if it is invalid."""
    path = files.clips
    try:
        shard = _LISTS.get_or_make(path, lambda: ListedShard.read(path))
    except ValidationError as error:
        raise _damaged() from error
    if any(number >= len(shard.clips.items) for number in files.dropped):
        raise _damaged()
    return shard


def _damaged() -> NotFoundProblem:
    return NotFoundProblem("A list of clips in the index is damaged; build the index again.", code="no-index")


class MappedShards:
    """Shards that a child process keeps mapped into memory between searches, at most `most_bytes` of files.

    Otherwise, up to a quarter of the processor time of a search would go into mapping them again, page by page. The
    mapped bytes are added to the memory that the process may use: they are files that are only read, so the system can
    take their memory back.
    """

    def __init__(self, most_bytes: int) -> None:
        self._shards: LruCache[tuple[str, str], tuple[Shard, int]] = LruCache(
            max_bytes=most_bytes, size_of=lambda one: one[1]
        )
        """Shards and sizes of their files, by the paths of poses and list of clips.

        Both paths are needed: anybody may write an index, and it can combine the poses of one index with the list of
        another.
        """
        self._allowed_bytes = 0

    @contextmanager
    def searching(self, shards: Iterable[ShardFiles]) -> Iterator[None]:
        """Allow the process to map some shards while the `with` block runs; forget shards whose files were removed."""
        kept = {paths for paths, _ in self._shards.items()}
        for paths in kept:
            if not Path(paths[0]).exists():
                self._shards.pop(paths)
        new = (files.poses for files in shards if (files.poses, files.clips) not in kept)
        self._allow(self._kept_bytes() + sum(Path(poses).stat().st_size for poses in new))
        try:
            yield
        finally:
            self._allow(self._kept_bytes())

    def open(self, files: ShardFiles, listed: ListedShard) -> Shard:
        """Return a shard, mapped into memory. Raises `MotionError` if its poses do not fit the list of its clips."""
        from marey_motion.similarity.shards import Shard

        def opened() -> tuple[Shard, int]:
            path = Path(files.poses)
            return Shard.open(path, listed.runs, listed.joints), path.stat().st_size

        return self._shards.get_or_make((files.poses, files.clips), opened)[0]

    def _kept_bytes(self) -> int:
        return sum(size for _, (_, size) in self._shards.items())

    def _allow(self, mapped_bytes: int) -> None:
        allow_mapped_files(mapped_bytes - self._allowed_bytes)
        self._allowed_bytes = mapped_bytes


MAPPED = MappedShards(MOST_MAPPED_BYTES)

"""A store of chunks for tests."""

from collections.abc import Iterable, Mapping


class ChunksInMemory(dict[str, bytes]):
    """Store of chunks in a dictionary."""

    def load(self, digests: Iterable[str]) -> Mapping[str, bytes]:
        """Return the bytes of the chunks that the store has."""
        return {digest: self[digest] for digest in digests if digest in self}

    def save(self, chunks: Mapping[str, bytes]) -> None:
        """Store the bytes of chunks by digest."""
        self.update(chunks)

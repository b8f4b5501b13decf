"""Counterparts of `marey_client.handles.models` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.handles.clips import AsyncClipHandle
from marey_client.asynchronous.handles.searches import AsyncSearchableHandle
from marey_client.handles.models import ModelHandle, Samples
from marey_schemas.formats import DEFAULT_FORMAT


@counterpart_of(ModelHandle)
class AsyncModelHandle(AsyncSearchableHandle):
    """Handle of a generative model of one action: its quality, its report, and motions drawn from it."""

    _sync: ModelHandle

    async def document(self, *, revision: int | None = None) -> dict[str, Any]:
        """Return the whole model, with numpy arrays: functions, mixture, options, examples and training report."""
        return await self._run(self._sync.document, revision=revision)

    async def training(self) -> dict[str, Any]:
        """Return the measured quality of the model: errors, likelihoods, examples, foot contacts and warnings."""
        return await self._run(self._sync.training)

    async def sample(self, n: int = 1, seed: int = 0, *, revision: int | None = None) -> Samples:
        """Draw `n` motions. The same seed gives the same motions; a greater `n` adds motions after them."""
        return await self._run(self._sync.sample, n, seed, revision=revision)

    async def save_samples(
        self,
        folder: str | Path,
        format: str = DEFAULT_FORMAT,
        *,
        n: int = 1,
        seed: int = 0,
        unit: str | None = None,
        revision: int | None = None,
    ) -> list[Path]:
        """Draw `n` motions, write them to files in `folder`, and return the paths of the files.

        `format` is "bvh", "npz" or "predecessor" (the format of Marey's predecessor) for one file per motion, or "json"
        for one file with all motions.
        """
        return await self._run(self._sync.save_samples, folder, format, n=n, seed=seed, unit=unit, revision=revision)

    async def add_samples(
        self, n: int = 1, seed: int = 0, *, into: str, tags: str | Sequence[str] = (), names: str | None = None
    ) -> list[AsyncClipHandle]:
        """Draw `n` motions and create clips from them in the folder `into`, on the model's skeleton.

        A clip is named `<model>_<seed>_<number>`; `names` replaces the model's name. Raises `Conflict` if a name is
        taken.
        """
        exchanged: list[AsyncClipHandle] = await self._exchange(
            self._sync.add_samples, n, seed, into=into, tags=tags, names=names
        )
        return exchanged

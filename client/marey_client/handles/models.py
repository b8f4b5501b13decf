"""Handles of generative models of motion: their quality, and motions drawn from them."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_client.arguments import checks_arguments
from marey_client.downloads import download, safe_file_name, saved_atomically
from marey_client.handles.clips import ClipHandle, MotionArrays
from marey_client.handles.searches import SearchableHandle
from marey_client.items import Items
from marey_schemas.documents.clips import ClipInfo, ClipSource
from marey_schemas.encoding.codecs import JSON, encode_tree
from marey_schemas.formats import DEFAULT_FORMAT
from marey_schemas.kinds import Kind


@dataclass(frozen=True, eq=False)
class Samples:
    """Motions drawn from a model.

    Parameters
    ----------
    latents : (n, L) latent vectors of the motions
    log_densities : (n,) natural logarithm of the probability density of each motion
    motions : n motions in the canonical frame: the body begins at x = z = 0 and faces +z
    """

    latents: NDArray[np.float64]
    log_densities: NDArray[np.float64]
    motions: tuple[MotionArrays, ...]


@checks_arguments
class ModelHandle(SearchableHandle):
    """Handle of a generative model of one action: its quality, its report, and motions drawn from it."""

    def document(self, *, revision: int | None = None) -> dict[str, Any]:
        """Return the whole model, with numpy arrays: functions, mixture, options, examples and training report."""
        return self.part("model", revision=revision)

    def training(self) -> dict[str, Any]:
        """Return the measured quality of the model: errors, likelihoods, examples, foot contacts and warnings."""
        return dict(self.document()["training"] or {})

    def sample(self, n: int = 1, seed: int = 0, *, revision: int | None = None) -> Samples:
        """Draw `n` motions. The same seed gives the same motions; a greater `n` adds motions after them."""
        tree = self._samples(n, seed, revision)
        motions = tuple(MotionArrays.model_validate(motion) for motion in tree["motions"])
        return Samples(tree["latents"], tree["log_densities"], motions)

    def save_samples(
        self,
        folder: str | Path,
        format: str = DEFAULT_FORMAT,  # noqa: A002
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
        if format == "json":
            target = Path(folder) / safe_file_name(f"{self.name} {seed}.json")
            return [_saved(target, encode_tree(self._samples(n, seed, revision), JSON))]
        params = {"n": str(n), "seed": str(seed), "format": format, "unit": unit, "revision": revision}
        if n == 1:
            name = f"{self.name} {seed}.{format}"
            return [download(self.transport, f"{self.url}/samples/export", folder, params=params, name=name)]
        given = {name: str(value) for name, value in params.items() if value is not None}
        response = self.transport.send("GET", f"{self.url}/samples/export", params=given, headers={"Accept": "*/*"})
        with zipfile.ZipFile(io.BytesIO(response.content)) as archive:
            return [_saved(Path(folder) / safe_file_name(name), archive.read(name)) for name in archive.namelist()]

    def add_samples(
        self, n: int = 1, seed: int = 0, *, into: str, tags: str | Sequence[str] = (), names: str | None = None
    ) -> list[ClipHandle]:
        """Draw `n` motions and create clips from them in the folder `into`, on the model's skeleton.

        A clip is named `<model>_<seed>_<number>`; `names` replaces the model's name. Raises `Conflict` if a name is
        taken.
        """
        tree = self._samples(n, seed, self.item.revision)
        clips = Items(self.transport, self.project, Kind.CLIP, ClipHandle)
        made = []
        for place, motion in enumerate(tree["motions"], start=1):
            details = {"model": tree["model"], "seed": seed, "place": place}
            info = ClipInfo(action=self.name, source=ClipSource(format="sampled", details=details))
            parts = {"motion": motion, "info": info.model_dump(mode="json", by_alias=True, exclude_none=True)}
            name = f"{names or self.name}_{seed}_{place:04d}"
            made.append(clips.create(name, parts, collection=into, tags=tags))
        return made

    def _samples(self, n: int, seed: int, revision: int | None) -> dict[str, Any]:
        tree, _ = self.transport.get_tree(f"{self.url}/samples", {"n": str(n), "seed": str(seed), "revision": revision})
        return dict(tree)


def _saved(path: str | Path, data: bytes) -> Path:
    with saved_atomically(path) as file:
        file.write(data)
    return Path(path)

"""Project in memory for tests of the functions that run jobs, and a small evaluation."""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from marey_motion.clip import Clip
from marey_motion.documents import clip_to_document, skeleton_to_document
from marey_schemas.documents.references import RevisionRef
from marey_schemas.encoding.codecs import MSGPACK, decode_tree
from marey_schemas.items import Item
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_params import EvaluateParams
from marey_schemas.queue.jobs import Progress
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput, StageRequest
from marey_worker.context import Context, NoSuchThing, Task, encode_outputs

NOW = "2026-01-01T00:00:00Z"
PARAMS = EvaluateParams(
    speeds_m_s=(1.0, 1.5),
    turn_rates_deg_s=(-50.0, 0.0, 50.0),
    duration_s=4.0,
    replicates=1,
    baseline=False,
    report=False,
)


@dataclass
class ProjectInMemory(Context):
    """Context of a job that keeps the project in memory and needs no server."""

    scratch: Path
    task: Task = field(default_factory=lambda: Task(0, 1))
    threads: int = 1
    inputs: dict[str, Any] = field(default_factory=dict)
    parts: dict[Any, Any] = field(default_factory=dict)
    blobs: dict[str, bytes] = field(default_factory=dict)
    staged: list[Any] = field(default_factory=list)
    facets: list[Any] = field(default_factory=list)
    told: list[Any] = field(default_factory=list)
    into: str = ""
    seed: int = 0

    def document(self, kind: Kind, item: str, revision: int, part: str, *, required: bool = True) -> Any:
        if required and (item, revision, part) not in self.parts:
            raise NoSuchThing(f"{item} has no {part}", f"no-{kind}")
        return self.parts.get((item, revision, part))

    def documents(self, pins: Iterable[PinnedInput], part: str, *, required: bool = True) -> Iterator[tuple[Any, ...]]:
        for pin in pins:
            held = self.parts.get((pin.item, pin.revision, part))
            assert held is not None or not required
            yield pin, held

    def documents_of_each(self, pins: Iterable[PinnedInput], *parts: Any) -> Iterator[tuple[Any, ...]]:
        for pin in pins:
            yield pin, tuple(self.parts.get((pin.item, pin.revision, part)) for part in parts)

    def item(self, kind: Kind, item: str) -> Item:
        return Item(
            id=item, kind=kind, name=item.upper(), collection="rigs", revision=1, created_at=NOW, updated_at=NOW, rev=1
        )

    def blob(self, digest: str) -> bytes:
        return self.blobs[digest]

    def put_file(self, path: Path) -> str:
        data = path.read_bytes()
        digest = f"sha256:{hashlib.sha256(data).hexdigest()}"
        self.blobs[digest] = data
        return digest

    def stage(self, outputs: Sequence[StagedOutput]) -> None:
        self._stage(encode_outputs(outputs))

    def _stage(self, body: bytes) -> None:
        request = StageRequest.model_validate(decode_tree(body, MSGPACK))
        self.staged += request.outputs
        self.facets += request.facets

    def log(self, text: str) -> None:
        print(text)

    def progress(self, done: float, total: float | None = None, note: str = "") -> None:
        Progress(done=done, total=total, note=note)  # as a real context, refuse what the server would refuse
        self.told.append((done, total, note))


def add_clip(project: ProjectInMemory, name: str, clip: Clip, skeleton: str = "skeleton_a") -> None:
    ref = RevisionRef(item=skeleton, revision=1)
    project.parts[skeleton, 1, "hierarchy"] = skeleton_to_document(clip.skeleton).model_dump(by_alias=True)
    project.parts[f"clip_{name}", 1, "motion"] = clip_to_document(clip, ref).model_dump(by_alias=True)
    pin = PinnedInput(item=f"clip_{name}", revision=1, kind=Kind.CLIP, name=name, collection="walks")
    project.inputs["clips"] = (*project.inputs.get("clips", ()), pin)

"""Kinds of items, and their parts."""

from dataclasses import dataclass
from enum import StrEnum

_NOUNS = {"processed": "aligned clip"}
_PLURALS = {"processed": "processed", "study": "studies", "index": "indexes"}


class Kind(StrEnum):
    """Kind of an item. The value is used in ids and documents, `plural` in URLs."""

    SKELETON = "skeleton"
    CLIP = "clip"
    ANNOTATION = "annotation"
    PROCESSED = "processed"
    MODEL = "model"
    GRAPH = "graph"
    CHARACTER = "character"
    EDIT = "edit"
    EVALUATION = "evaluation"
    METRIC = "metric"
    STUDY = "study"
    INDEX = "index"
    RECORD = "record"

    @property
    def plural(self) -> str:
        """The name of the kind in URLs, for example `clips`."""
        return _PLURALS.get(self.value, f"{self.value}s")

    @property
    def noun(self) -> str:
        """The kind in texts for people, for example `clip` or `aligned clip`."""
        return _NOUNS.get(self.value, self.value)

    @classmethod
    def from_plural(cls, plural: str) -> "Kind":
        """Return the kind with the given name in URLs. Raises `KeyError` if there is none."""
        return _BY_PLURAL[plural]


_BY_PLURAL = {kind.plural: kind for kind in Kind}


@dataclass(frozen=True)
class PartSpec:
    """Declaration of a part of the items of a kind: the schema of its document, and whether revisions must have it."""

    schema: str
    required: bool
    made_from: str | None = None
    """Part that this part describes or was computed from. A merge takes both parts from the same side."""


PARTS: dict[Kind, dict[str, PartSpec]] = {
    Kind.SKELETON: {
        "hierarchy": PartSpec("marey/skeleton@1", True),
        "mapping": PartSpec("marey/skeleton-mapping@1", False),
    },
    Kind.CLIP: {"motion": PartSpec("marey/motion@1", True), "info": PartSpec("marey/clip-info@1", False)},
    Kind.ANNOTATION: {"annotation": PartSpec("marey/annotation@1", True)},
    Kind.PROCESSED: {"motion": PartSpec("marey/motion@1", True), "info": PartSpec("marey/alignment@1", True, "motion")},
    Kind.MODEL: {
        "model": PartSpec("marey/motion-primitive@1", True),
        "tree": PartSpec("marey/sample-tree@1", False, "model"),
        "report": PartSpec("marey/model-report@1", False, "model"),
    },
    Kind.GRAPH: {"graph": PartSpec("marey/model-graph@1", True)},
    Kind.CHARACTER: {"character": PartSpec("marey/document@1", True)},
    Kind.EDIT: {"edit": PartSpec("marey/edit@1", True)},
    Kind.EVALUATION: {
        "evaluation": PartSpec("marey/evaluation@1", True),
        "records": PartSpec("marey/evaluation-records@1", False, "evaluation"),
        "report": PartSpec("marey/evaluation-report@1", False, "evaluation"),
    },
    Kind.METRIC: {"metric": PartSpec("marey/perceptual-metric@1", True)},
    Kind.INDEX: {"index": PartSpec("marey/motion-index@1", True)},
    Kind.STUDY: {"study": PartSpec("marey/study@1", True)},
    Kind.RECORD: {"record": PartSpec("marey/predecessor-record@1", True)},
}
"""Parts by kind of item. Kinds whose schema is not fixed yet use `marey/document@1`, which allows any members."""

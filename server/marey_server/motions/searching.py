"""Models and their search trees, which requests search for motions.

One transaction reads the documents of a model; a child process parses and caches the documents.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from marey_schemas.documents.models import log_likelihoods
from marey_schemas.documents.skeletons import SkeletonMapping
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.search import SearchRequest
from marey_server.errors import InvalidProblem, NotFoundProblem, TooLargeProblem
from marey_server.motions import models
from marey_server.motions.child import Message, unpack_tree
from marey_server.motions.models import FoundModel, LoadedModel, PackedModel, UsableModel
from marey_server.store import items
from marey_server.store.items.reading import FoundPart
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:
    from marey_motion.modelling.search.tree import SampleTree
    from marey_motion.rigs import JointMapping

MOST_DRAWING_WORK = 2e9
"""Greatest cost of drawing samples for all models without a tree in a request, in nanoseconds of one thread."""

SearchableKey = tuple[str, str, str]


@dataclass(frozen=True, slots=True)
class FoundSearchable:
    """Model that the caller may search, with its search tree and the joint mapping of its skeleton, if they exist.

    `tree` is None if the stored tree belongs to another state of the model.
    """

    model: FoundModel
    tree: FoundPart | None
    mapping: FoundPart | None

    @property
    def key(self) -> SearchableKey:
        """The digests of the model, its tree and its mapping; "" for a tree or mapping that does not exist."""
        tree, mapping = ("" if part is None else part.digest for part in (self.tree, self.mapping))
        return self.model.part.digest, tree, mapping

    @property
    def size_bytes(self) -> int:
        """The size in bytes of the documents of the model, its tree and its mapping."""
        return sum(part.size_bytes for part in (self.model.part, self.tree, self.mapping) if part is not None)


class SearchedModels(Message):
    """Models of the steps of a search; `packed` maps the id of each model's item to the bytes of a `PackedModel`."""

    found: tuple[FoundSearchable, ...]
    packed: dict[str, bytes]


@dataclass(frozen=True, slots=True)
class LoadedSearchable:
    """Documents of a model to be searched, with its search tree and joint mapping, if they exist."""

    model: LoadedModel
    tree: dict[str, Any] | None
    mapping: dict[str, Any] | None

    def pack(self) -> bytes:
        """Return the documents as the bytes of a `PackedModel`."""
        return models.pack_model(self.model, self.tree, self.mapping)


@dataclass(frozen=True, slots=True)
class Searchable:
    """Parsed model that can be searched.

    `stored` is true if the tree is stored with the model, and false if it was built for the search from random samples.
    `drawing_work` is the estimated computing time for drawing these samples, in nanoseconds. `log_likelihoods` are the
    log-likelihoods of the examples in ascending order. `standard_joints` maps standard names of joints to indices in
    the skeleton.
    """

    usable: UsableModel
    tree: SampleTree
    stored: bool
    drawing_work: float
    mapping: JointMapping
    standard_joints: dict[str, int]
    log_likelihoods: tuple[float, ...]


def find_searchables(
    tx: Transaction, project: str, kind: Kind, item_id: str, request: SearchRequest
) -> list[FoundSearchable]:
    """Return the model to search in each step of the request. Raises `NotFoundProblem` if a model does not exist."""
    if kind is not Kind.MODEL:
        raise NotFoundProblem(f"Only models can be searched, not an item of the kind {kind}.", code="not-a-model")
    wanted = [step.model or item_id for step in request.asked_steps]
    found = {item: _find(tx, project, item) for item in dict.fromkeys(wanted)}
    return [found[item] for item in wanted]


def load_searchable(tx: Transaction, project: str, found: FoundSearchable) -> LoadedSearchable:
    """Read the documents of a model, and its tree and joint mapping if they exist.

    Raises `NotFoundProblem` if the model's skeleton was deleted.
    """
    tree, mapping = (None if part is None else items.load_part(tx, part) for part in (found.tree, found.mapping))
    return LoadedSearchable(models.load_model(tx, project, found.model), tree, mapping)


def _find(tx: Transaction, project: str, item_id: str) -> FoundSearchable:
    model = models.find_model(tx, project, Kind.MODEL, item_id, None)
    ref = items.load_part(tx, model.part, arrays="none")["skeleton"]
    held = items.read_item(tx, project, Kind.SKELETON, ref["item"]).parts
    tree = mapping = None
    if "tree" in items.read_item(tx, project, Kind.MODEL, item_id).parts:
        found = items.find_part(tx, project, Kind.MODEL, item_id, "tree")
        if items.load_part(tx, found, arrays="none")["model_digest"] == model.part.digest:
            tree = found
    if "mapping" in held:
        mapping = items.find_part(tx, project, Kind.SKELETON, ref["item"], "mapping")
    return FoundSearchable(model, tree, mapping)


# -- in the child ------------------------------------------------------------------------------------------------------


def usable_searchables(models: SearchedModels, seed: int, most_work: float) -> list[Searchable]:
    """Return the model for each step of a search request, with a tree of samples that can be searched.

    The models are parsed, or taken from the cache. For a model without a stored tree, samples are drawn, and a tree is
    built from them. Raises `TooLargeProblem` if drawing the samples for all models of the request would take too long.
    """
    usable: dict[str, Searchable] = {}
    for one in models.found:
        item = one.model.item
        if item not in usable:
            drawn_from = seed if one.tree is None else None
            usable[item] = _SEARCHABLES.get_or_make(
                (one.key, drawn_from), partial(_parse_packed, models.packed[item], seed, most_work)
            )
            require_drawable(sum(each.drawing_work for each in usable.values()), most_work)
    return [usable[one.model.item] for one in models.found]


def _parse_packed(packed: bytes, seed: int, most_work: float) -> Searchable:
    documents = PackedModel.unpack(packed)
    tree, mapping = (None if part is None else unpack_tree(part) for part in (documents.tree, documents.mapping))
    return parse_searchable(LoadedSearchable(documents.loaded(), tree, mapping), seed, most_work)


def parse_searchable(loaded: LoadedSearchable, seed: int, most_work: float) -> Searchable:
    """Return the parsed model with a tree; a missing tree is built from samples that are drawn with `seed`.

    Raises `InvalidProblem` if numbers of the model are not valid, and `TooLargeProblem` if drawing the samples would
    cost more than `most_work`, in nanoseconds of one thread.
    """
    from marey_motion.documents import mapping_from_document
    from marey_motion.errors import MotionError
    from marey_motion.modelling.search.tree import END_EFFECTORS, build_tree
    from marey_motion.modelling.search.tree_documents import sample_tree_from_tree
    from marey_motion.modelling.search.work import drawing_work
    from marey_motion.rigs import map_joints

    usable = models.parse_model(loaded.model)
    primitive, skeleton = usable.primitive, usable.primitive.skeleton
    try:
        if loaded.mapping is None:
            mapping = map_joints(skeleton)
        else:
            mapping = mapping_from_document(SkeletonMapping.model_validate(loaded.mapping), skeleton)[0]
        standard_joints = {name: skeleton.index_of(joint) for name, joint in mapping.joints.items()}
        work = 0.0
        if loaded.tree is not None:
            tree = sample_tree_from_tree(loaded.tree)
        else:
            known = [standard_joints[name] for name in END_EFFECTORS if name in standard_joints]
            work = drawing_work(primitive, end_effectors=known)
            require_drawable(work, most_work)
            tree = build_tree(primitive, seed, end_effectors=known)
        tree.means, tree.starts  # noqa: B018    computed here, once for all searches
    except MotionError as error:
        raise InvalidProblem(f"The model cannot be searched: {error}", code=error.code) from error
    stored = loaded.tree is not None
    likelihoods = tuple(sorted(log_likelihoods(loaded.model.model)))
    return Searchable(usable, tree, stored, work, mapping, standard_joints, likelihoods)


def require_drawable(work: float, most_work: float) -> None:
    """Raise `TooLargeProblem` if drawing samples for the missing trees of a request costs more than `most_work`."""
    if work > most_work:
        raise TooLargeProblem(
            "Some models of the search have no tree, and drawing samples to build the trees takes too long; create a "
            "tree for each model first, with a job of the kind `tree` or with `marey tree`.",
            code="tree-missing",
        )


def size_bytes(made: Searchable) -> int:
    """Return the size in bytes of a model's arrays and of its tree's arrays."""
    return models.size_bytes(made.usable) + made.tree.samples.nbytes + made.tree.means.nbytes


_SEARCHABLES: LruCache[tuple[SearchableKey, int | None], Searchable] = LruCache(
    max_bytes=models.MODEL_CACHE_BYTES, size_of=size_bytes
)
"""Cache of a child process: parsed models, by the digests of a model's documents and the seed of a drawn tree."""

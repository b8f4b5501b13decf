"""Models from which requests draw samples.

One transaction reads the documents of a model. A child process parses the documents, caches the model, and draws
samples from it.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.formats import ZIP_EPOCH, MotionFormat, WrittenUnit
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.sizes import MIB
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.motions.child import AnswerEncoding, ComputedFile, Message, pack_tree, unpack_tree
from marey_server.store import items
from marey_server.store.items.reading import FoundPart
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:  # numeric modules are loaded by children alone
    from marey_motion.arrays import Floats
    from marey_motion.clip import Clip
    from marey_motion.modelling.primitive import MotionPrimitive

DRAW_SAMPLES = "marey_server.motions.models:draw_samples"
WRITE_SAMPLES = "marey_server.motions.models:write_samples"
"""Function that child processes run; so is `DRAW_SAMPLES`."""
MODEL_CACHE_BYTES = 32 * MIB
"""Greatest size of a child's cache of parsed models; models with search trees have a cache of the same size."""
LARGEST_ANSWER_BYTES = 32 * MIB
"""Greatest size in bytes of the poses of all samples in an answer."""

SAMPLES_SCHEMA = "marey/motion-samples@1"


@dataclass(frozen=True, slots=True)
class FoundModel:
    """Revision of a model that the caller may read, and where its document is stored."""

    item: str
    name: str
    part: FoundPart


@dataclass(frozen=True, slots=True)
class LoadedModel:
    """Documents of a model: its part `model`, and the `hierarchy` of its skeleton."""

    model: dict[str, Any]
    hierarchy: dict[str, Any]


class PackedModel(Message):
    """Documents of a model as bytes; for searches also the search tree and the joint mapping, if these exist."""

    model: bytes
    hierarchy: bytes
    tree: bytes | None = None
    mapping: bytes | None = None

    def loaded(self) -> LoadedModel:
        """Return the documents of the model, with decoded arrays."""
        return LoadedModel(unpack_tree(self.model), unpack_tree(self.hierarchy))


class SampleOrder(Message):
    """Message that asks a child process to draw samples from a model and return them as a document."""

    found: FoundModel
    model: bytes
    count: int
    seed: int
    encoding: AnswerEncoding


class SampleFileOrder(Message):
    """Message that asks a child process to draw samples from a model and return them as a file."""

    found: FoundModel
    model: bytes
    count: int
    seed: int
    format: MotionFormat
    unit: WrittenUnit


@dataclass(frozen=True, slots=True)
class UsableModel:
    """Parsed model that can generate motion."""

    primitive: MotionPrimitive
    skeleton: RevisionRef


def find_model(tx: Transaction, project: str, kind: Kind, item_id: str, revision: int | None) -> FoundModel:
    """Return the model of an item. Raises `NotFoundProblem` if the item is not a model or does not exist."""
    if kind is not Kind.MODEL:
        raise NotFoundProblem(
            f"Motions can be generated only from models, not from an item of the kind {kind}.", code="not-a-model"
        )
    part = items.find_part(tx, project, kind, item_id, "model", revision=revision)
    return FoundModel(item_id, items.read_item(tx, project, kind, item_id).name, part)


def load_model(tx: Transaction, project: str, found: FoundModel) -> LoadedModel:
    """Read the model's documents, with encoded arrays. Raises `NotFoundProblem` if the model's skeleton was deleted."""
    model = items.load_part(tx, found.part)
    ref = model["skeleton"]
    skeleton = items.read_part(tx, project, Kind.SKELETON, ref["item"], "hierarchy", revision=ref["revision"])
    return LoadedModel(model, skeleton.tree)


def pack_model(loaded: LoadedModel, tree: dict[str, Any] | None, mapping: dict[str, Any] | None) -> bytes:
    """Return a model with its tree and mapping as the bytes of a `PackedModel`."""
    return PackedModel(
        model=pack_tree(loaded.model),
        hierarchy=pack_tree(loaded.hierarchy),
        tree=None if tree is None else pack_tree(tree),
        mapping=None if mapping is None else pack_tree(mapping),
    ).pack()


# -- in the child ------------------------------------------------------------------------------------------------------


def draw_samples(packed: bytes) -> bytes:
    """Draw samples from a model, in a child process. `packed` is a `SampleOrder` as bytes.

    Return the document of the samples, encoded for the client.
    """
    order = SampleOrder.unpack(packed)
    model = _usable_model(order.found, order.model)
    return order.encoding.encode(sample_document(order.found, model, order.count, order.seed))


def write_samples(packed: bytes) -> bytes:
    """Draw samples from a model and write them to a file, in a child process. `packed` is a `SampleFileOrder` as bytes.

    Return a `ComputedFile` as bytes.
    """
    order = SampleFileOrder.unpack(packed)
    model = _usable_model(order.found, order.model)
    return sample_file(order.found, model, order.count, order.seed, order.format, order.unit).pack()


def _usable_model(found: FoundModel, packed: bytes) -> UsableModel:
    return _MODELS.get_or_make(found.part.digest, lambda: parse_model(PackedModel.unpack(packed).loaded()))


def parse_model(loaded: LoadedModel) -> UsableModel:
    """Return the model that the documents describe. Raises `InvalidProblem` if numbers of the model are not valid."""
    from marey_motion.documents import skeleton_from_document
    from marey_motion.errors import MotionError
    from marey_motion.modelling.primitive_documents import primitive_from_tree

    skeleton = skeleton_from_document(SkeletonHierarchy.model_validate(loaded.hierarchy))
    try:
        primitive = primitive_from_tree(loaded.model, skeleton)
        primitive.prior.cholesky  # noqa: B018    computed here so that an impossible mixture is refused here
    except MotionError as error:
        raise InvalidProblem(f"The model cannot be used: {error}", code=error.code) from error
    return UsableModel(primitive, RevisionRef.model_validate(loaded.model["skeleton"]))


def size_bytes(model: UsableModel) -> int:
    """Return the size in bytes of a model's arrays, including arrays that are computed from its mixture."""
    primitive = model.primitive
    parts = (primitive.spatial, primitive.temporal)
    arrays = [array for part in parts for array in (part.mean, part.directions, part.projections)]
    return 3 * primitive.mixture.covariances.nbytes + sum(array.nbytes for array in arrays)


_MODELS: LruCache[str, UsableModel] = LruCache(max_bytes=MODEL_CACHE_BYTES, size_of=size_bytes)
"""Cache of a child process: parsed models by the digest of their document."""


def sample_document(found: FoundModel, model: UsableModel, count: int, seed: int) -> dict[str, Any]:
    """Return samples as a document: latent vectors, likelihoods, motions.

    Raises `InvalidProblem` if the samples are too large for an answer.
    """
    from marey_motion.documents import clip_to_document

    latents, clips = _draw(model.primitive, count, seed)
    return {
        "schema": SAMPLES_SCHEMA,
        "model": {"item": found.item, "revision": found.part.revision, "digest": found.part.digest},
        "seed": seed,
        "latents": latents,
        "log_densities": model.primitive.log_density(latents),
        "motions": [clip_to_document(clip, model.skeleton).model_dump(by_alias=True) for clip in clips],
    }


def sample_file(
    found: FoundModel, model: UsableModel, count: int, seed: int, file_format: MotionFormat, unit: str
) -> ComputedFile:
    """Return one sample as a file, or several samples as a ZIP archive of files.

    Raises `InvalidProblem` if the samples are too large, or if the format cannot represent them.
    """
    from marey_motion.errors import MotionError
    from marey_motion.exporting import write_clip_file

    _, clips = _draw(model.primitive, count, seed)
    try:
        files = [write_clip_file(clip, file_format, unit=unit) for clip in clips]
    except MotionError as error:
        raise InvalidProblem(str(error), code="cannot-be-exported") from error
    stem = f"{found.name}_{seed}"
    if count == 1:
        return ComputedFile(name=stem + files[0].suffix, media_type=files[0].media_type, data=files[0].data)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for place, file in enumerate(files, start=1):
            archive.writestr(_entry(f"{stem}_{place:04d}{file.suffix}"), file.data, compresslevel=6)
    return ComputedFile(name=f"{stem}.zip", media_type="application/zip", data=packed.getvalue())


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, ZIP_EPOCH)
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


def _draw(primitive: MotionPrimitive, count: int, seed: int) -> tuple[Floats, list[Clip]]:
    """Return latent vectors, of shape (count, L), drawn from the model, and their motions."""
    latents = primitive.sample(count, seed)
    frames = float((primitive.time_functions(latents)[:, -1] + 1.5).sum())
    size = frames * primitive.spatial.mean.shape[1] * 4
    if not size <= LARGEST_ANSWER_BYTES:
        raise InvalidProblem(
            f"The poses of these samples take {size / MIB:,.0f} MiB, and an answer may have at most "
            f"{LARGEST_ANSWER_BYTES // MIB} MiB; request fewer samples.",
            code="samples-too-large",
        )
    motions = primitive.motions(latents)
    return latents, [motion.as_clip(primitive.skeleton, primitive.frame_rate_hz) for motion in motions]

"""Resources that generate motions from models; the same seed gives the same motions."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.documents.models import MOST_SAMPLES
from marey_schemas.formats import DEFAULT_FORMAT, DEFAULT_UNIT, MOTION_MEDIA_TYPES, MotionFormat, WrittenUnit
from marey_schemas.sizes import MOST_INTEGER, SEEDS
from marey_server.handlers.items import kind_of
from marey_server.http.caching import caching_of_revision
from marey_server.http.declarations import Access, Bytes, Document, reads
from marey_server.http.reply import Reply
from marey_server.http.resource import Resource
from marey_server.http.streaming import attachment
from marey_server.motions import models, searching
from marey_server.motions.child import ComputedFile
from marey_server.motions.models import FoundModel, SampleFileOrder, SampleOrder
from marey_server.motions.searching import FoundSearchable


class SampleQuery(Request):
    """Query parameters of samples: their number and seed, and the revision of the model."""

    n: int = Field(
        1,
        ge=1,
        le=MOST_SAMPLES,
        description="Number of samples; with a larger number, the first samples stay the same.",
    )
    seed: int = Field(
        0, ge=0, lt=SEEDS, description="Seed of the random numbers; the same seed gives the same samples."
    )
    revision: int | None = Field(None, ge=1, le=MOST_INTEGER, description="Revision of the model; absent: the newest.")


class SampleFileQuery(SampleQuery):
    """Query parameters of samples that are sent as files: those of `SampleQuery`, the file format, and its unit."""

    format: MotionFormat = Field(
        DEFAULT_FORMAT, description="File format; several files are returned in one ZIP archive."
    )
    unit: WrittenUnit = Field(DEFAULT_UNIT, description="Unit of length of BVH files.")


class ModelUser(Resource):
    """Base of resources that let a model generate motion."""

    async def packed_model(self, project: str, found: FoundSearchable) -> bytes:
        """Return the documents of a model as bytes for a child process; recently used documents are cached."""
        known = self.services.models.get(found.key)
        if known is None:
            loaded = await self.look_up(searching.load_searchable, project, found)
            self.holding.grow(found.size_bytes)
            known = await self.compute(loaded.pack)
            self.services.models.put(found.key, known)
        return known

    async def found_model(self, project: str, kind: str, item: str, revision: int | None) -> tuple[FoundModel, bytes]:
        """Return the requested model, and its documents as bytes for a child process."""
        found = await self.look_up(models.find_model, project, kind_of(kind), item, revision)
        return found, await self.packed_model(project, FoundSearchable(found, tree=None, mapping=None))


class ModelSamples(ModelUser):
    """Samples of a model as a document."""

    path = "/projects/{project}/{kind}/{item}/samples"
    tag = "Models"

    @reads(access=Access.READER, query=SampleQuery, answer=Document, etag=True)
    async def get(self, project: str, kind: str, item: str, query: SampleQuery) -> Reply:
        """Return motions drawn from a model (kind `models`), with their latent vectors and likelihoods.

        The same revision and seed give the same answer. `motions` are documents like the part `motion` of a clip.
        """
        found, model = await self.found_model(project, kind, item, query.revision)
        order = SampleOrder(found=found, model=model, count=query.n, seed=query.seed, encoding=self.media.encoding)
        drawn = await self.compute_apart(models.DRAW_SAMPLES, order.pack, bytes)
        return Reply(drawn, media_type=str(self.media), rev=_state(found, query), headers=_caching(query))


class SampleFiles(ModelUser):
    """Samples of a model as files."""

    path = "/projects/{project}/{kind}/{item}/samples/export"
    tag = "Models"

    @reads(
        access=Access.READER,
        query=SampleFileQuery,
        answer=Bytes,
        answer_types=(*MOTION_MEDIA_TYPES, "application/zip"),
    )
    async def get(self, project: str, kind: str, item: str, query: SampleFileQuery) -> Reply:
        """Return motions drawn from a model (kind `models`): one motion as a file, several as a ZIP archive."""
        found, model = await self.found_model(project, kind, item, query.revision)
        order = SampleFileOrder(
            found=found, model=model, count=query.n, seed=query.seed, format=query.format, unit=query.unit
        )
        file = await self.compute_apart(models.WRITE_SAMPLES, order.pack, ComputedFile.unpack)
        headers = {"Content-Disposition": attachment(file.name), **_caching(query)}
        return Reply(file.data, media_type=file.media_type, headers=headers)


def _state(found: FoundModel, query: SampleQuery) -> str:
    """Return the text from which the ETag of samples is made: digest and revision of the model, count and seed."""
    return f"{found.part.digest.removeprefix('sha256:')[:32]}.{found.part.revision}.{query.n}.{query.seed}"


def _caching(query: SampleQuery) -> dict[str, str]:
    return {"Cache-Control": caching_of_revision(query.revision)}


RESOURCES: tuple[type[Resource], ...] = (ModelSamples, SampleFiles)
"""Resources of this module."""

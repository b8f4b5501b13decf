"""Resources that search models for motions that meet constraints."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.formats import DEFAULT_FORMAT, DEFAULT_UNIT, MOTION_MEDIA_TYPES, MotionFormat, WrittenUnit
from marey_schemas.search import SearchRequest
from marey_server.handlers.items import kind_of
from marey_server.handlers.samples import ModelUser
from marey_server.http.caching import REVALIDATED
from marey_server.http.declarations import Access, Bytes, Document, reads
from marey_server.http.reply import Reply
from marey_server.http.resource import Resource
from marey_server.http.streaming import attachment
from marey_server.motions import search_answers, searching
from marey_server.motions.child import ComputedFile
from marey_server.motions.search_answers import SearchAnswerOrder, SearchFileOrder
from marey_server.motions.searching import SearchedModels


class FoundFileQuery(Request):
    """Query parameters of a search whose result is a file: the format of the file and its unit of length."""

    format: MotionFormat = Field(DEFAULT_FORMAT, description="File format of the motion.")
    unit: WrittenUnit = Field(DEFAULT_UNIT, description="Unit of length of a BVH file.")


class Searcher(ModelUser):
    """Base of resources that search models."""

    async def searched_models(self, project: str, kind: str, item: str, request: SearchRequest) -> SearchedModels:
        """Return the model of each step of a search; the models' documents are bytes for a child process."""
        found = await self.look_up(searching.find_searchables, project, kind_of(kind), item, request)
        packed: dict[str, bytes] = {}
        for one in found:
            if one.model.item not in packed:
                packed[one.model.item] = await self.packed_model(project, one)
        return SearchedModels(found=found, packed=packed)


class Search(Searcher):
    """Search for motions of a model."""

    path = "/projects/{project}/{kind}/{item}/search"
    tag = "Models"

    @reads(access=Access.READER, body=SearchRequest, answer=Document)
    async def post(self, project: str, kind: str, item: str, body: SearchRequest) -> Reply:
        """Return the motion of a model (kind `models`) that meets constraints best, or a sequence of motions.

        The model's tree is searched, and the best sample is refined. If the model has no tree, or a tree for another
        state of the model, a tree of new samples is built for the search; `steps[].tree` reports this. Nothing is
        stored, and the same request gets the same answer.
        """
        models, limits = await self.searched_models(project, kind, item, body), search_answers.search_limits()
        order = SearchAnswerOrder(request=body, models=models, limits=limits, encoding=self.media.encoding)
        answer = await self.compute_apart(search_answers.ANSWER_SEARCH, order.pack, bytes)
        return Reply(answer, media_type=str(self.media))


class SearchFile(Searcher):
    """Search for motions of a model, with the result as a file."""

    path = "/projects/{project}/{kind}/{item}/search/export"
    tag = "Models"

    @reads(
        access=Access.READER,
        query=FoundFileQuery,
        body=SearchRequest,
        answer=Bytes,
        answer_types=MOTION_MEDIA_TYPES,
    )
    async def post(self, project: str, kind: str, item: str, query: FoundFileQuery, body: SearchRequest) -> Reply:
        """Return the motion found by a search as one file; the motions of several steps are joined in this file."""
        models, limits = await self.searched_models(project, kind, item, body), search_answers.search_limits()
        order = SearchFileOrder(request=body, models=models, limits=limits, format=query.format, unit=query.unit)
        file = await self.compute_apart(search_answers.WRITE_SEARCH, order.pack, ComputedFile.unpack)
        headers = {"Content-Disposition": attachment(file.name), "Cache-Control": REVALIDATED}
        return Reply(file.data, media_type=file.media_type, headers=headers)


RESOURCES: tuple[type[Resource], ...] = (Search, SearchFile)

"""Resources that search models for motions that meet constraints."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.formats import DEFAULT_FORMAT, DEFAULT_UNIT, MOTION_MEDIA_TYPES, MotionFormat, WrittenUnit
from marey_schemas.search import SearchRequest
from marey_server.handlers.items import kind_of
from marey_server.http.declarations import Access, Bytes, Document, reads
from marey_server.http.reply import Rendered, Reply, render
from marey_server.http.resource import Resource
from marey_server.http.streaming import attachment
from marey_server.motions import search_answers, searching
from marey_server.motions.searching import FoundSearchable, Searchable, SearchableKey


class FoundFileQuery(Request):
    """Query of a search with a file as result: its format and unit."""

    format: MotionFormat = Field(DEFAULT_FORMAT, description="File format of the motion.")
    unit: WrittenUnit = Field(DEFAULT_UNIT, description="Unit of length of a BVH file.")


class Searcher(Resource):
    """Base of resources that search models."""

    async def searchables(
        self, project: str, kind: str, item: str, request: SearchRequest
    ) -> tuple[list[FoundSearchable], list[Searchable]]:
        """Return the model of each step with its tree, parsed; the most recently used ones are cached."""
        found = await self.look_up(searching.find_searchables, project, kind_of(kind), item, request)
        parsed: dict[SearchableKey, Searchable] = {}
        for one in found:
            key = one.key(request.seed)
            if key not in parsed:
                parsed[key] = await self._parsed(project, one, request.seed)
                searching.require_drawable(sum(each.drawing_work for each in parsed.values()))
        return found, [parsed[one.key(request.seed)] for one in found]

    async def _parsed(self, project: str, found: FoundSearchable, seed: int) -> Searchable:
        key = found.key(seed)
        known = self.services.searchables.get(key)
        if known is None:
            loaded = await self.look_up(searching.load_searchable, project, found)
            known = await self.compute_long(searching.parse_searchable, loaded, seed)
            self.services.searchables.put(key, known)
        return known


class Search(Searcher):
    """Search for motions of a model."""

    path = "/projects/{project}/{kind}/{item}/search"
    tag = "Models"

    @reads(access=Access.READER, body=SearchRequest, answer=Document)
    async def post(self, project: str, kind: str, item: str, body: SearchRequest) -> Rendered:
        """Return the motion of a model (kind `models`) that meets constraints best, or a sequence of motions.

        The model's tree is searched, and the best sample is refined. If the model has no tree, or the tree belongs to
        another state of the model, a tree of new samples is built for the search; `steps[].tree` reports this. Nothing
        is stored, and the same request gets the same answer.
        """
        found, searchables = await self.searchables(project, kind, item, body)
        form, answers = self.answer_form, self.services.answers

        def answered() -> Rendered:
            result = search_answers.search(searchables, body)
            return render(Reply(search_answers.answer_of(result, searchables, found, body)), form, answers)

        return await self.compute_long(answered)


class SearchFile(Searcher):
    """Search for motions of a model, as a file."""

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
        """Return the motion found by a search as one file, with all its steps."""
        found, searchables = await self.searchables(project, kind, item, body)

        def written() -> Reply:
            result = search_answers.search(searchables, body)
            file = search_answers.file_of(result, found, query.format, query.unit)
            headers = {"Content-Disposition": attachment(file.name), "Cache-Control": "private, no-cache"}
            return Reply(file.data, media_type=file.media_type, headers=headers)

        return await self.compute_long(written)


RESOURCES: tuple[type[Resource], ...] = (Search, SearchFile)

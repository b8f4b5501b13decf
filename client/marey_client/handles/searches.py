"""Searches for motions of models that meet constraints, and the trees that make searches fast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

from pydantic import BaseModel

from marey_client.arguments import checked, checks_arguments, several
from marey_client.downloads import safe_file_name, saved_atomically
from marey_client.handles.reports import ReportedHandle
from marey_client.jobs import Jobs, OnProgress, job_request
from marey_client.keywords.asking import SearchKeywords
from marey_client.keywords.processing import TreeKeywords
from marey_client.transport import BLOCKS, as_json, read_tree, sends_nothing
from marey_schemas.formats import DEFAULT_FORMAT, DEFAULT_UNIT
from marey_schemas.queue.job_params import TreeParams
from marey_schemas.queue.jobs import Job, JobCreate
from marey_schemas.search import SearchAnswer, SearchRequest

Constraint = Mapping[str, Any] | BaseModel
Constraints = Constraint | Sequence[Constraint]
"""Constraints such as `{"type": "joint_position", "joint": "left_wrist", "at": "end", "target_m": (0.3, 1, None)}`."""


@checks_arguments
class SearchableHandle(ReportedHandle):
    """Handle of an item whose motions can be searched."""

    def search(self, constraints: Constraints = (), **options: Unpack[SearchKeywords]) -> SearchAnswer:
        """Return the motion of the model that meets `constraints` best, and the error of each constraint.

        `options` are those of `SearchRequest`. The option `steps` requests a sequence of motions; each step has its own
        constraints and, if it needs another model, the id of that model.
        """
        request = search_request(constraints, **options)
        response = self.transport.send(
            "POST", f"{self.url}/search", content=as_json(request), headers={"Accept": BLOCKS}, repeatable=True
        )
        return SearchAnswer.model_validate(read_tree(response))

    def save_search(
        self,
        path: str | Path,
        constraints: Constraints = (),
        *,
        format: str = DEFAULT_FORMAT,  # noqa: A002
        unit: str = DEFAULT_UNIT,
        **options: Unpack[SearchKeywords],
    ) -> Path:
        """Write the result of a search to a motion file (bvh, npz or predecessor), and return the path of the file."""
        response = self.transport.send(
            "POST",
            f"{self.url}/search/export",
            params={"format": format, "unit": unit},
            content=as_json(search_request(constraints, **options)),
            headers={"Accept": "*/*"},
            repeatable=True,
        )
        target = Path(path)
        if target.is_dir():
            target /= safe_file_name(f"{self.name} found.{format}")
        with saved_atomically(target) as file:
            file.write(response.content)
        return target

    def make_tree(
        self, *, seed: int = 0, on_progress: OnProgress | None = None, **options: Unpack[TreeKeywords]
    ) -> Job:
        """Submit a job that builds the model's part `tree` from samples, and wait for its end.

        Raises `JobUnsuccessful` if the job does not succeed.

        `options` are those of `TreeParams`.
        """
        request = self.tree_request(**options).model_copy(update={"seed": seed})
        return Jobs(self.transport).run(self.project, request, on_progress=on_progress)

    @sends_nothing
    def tree_request(self, **options: Unpack[TreeKeywords]) -> JobCreate:
        """Return the job request of `make_tree`; `options` are those of `TreeParams`."""
        return job_request("tree", {"model": self.as_input()}, checked(TreeParams, options))


def search_request(constraints: Constraints, **options: Unpack[SearchKeywords]) -> SearchRequest:
    """Return a search request with the given constraints; `options` are further fields of `SearchRequest`."""
    return checked(SearchRequest, {"constraints": several(constraints), **options})

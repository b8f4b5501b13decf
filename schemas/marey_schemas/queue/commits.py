"""Commits of job outputs to datasets: the request in the submission of a job, and the result in the job."""

from __future__ import annotations

import re
from typing import Any, Literal

from pydantic import Field

from marey_schemas.base import Answer, Options, Request
from marey_schemas.datasets.naming import MAIN, DatasetName, RefName
from marey_schemas.names import CollectionPath, Message

MOST_COMMITTED = 200_000
"""Greatest number of entries that the commit of a job adds, changes or removes; the limit bounds the memory used."""
MOST_COMMITTED_AT_ONCE = 10_000
"""Greatest number of outputs whose commit is computed in the transaction that publishes them.

During this transaction, other writers wait.
"""
MOST_LISTED = 100
"""Greatest number of paths that a conflict lists."""

_PLACE = re.compile(r"([^/@]+)(?:@([^/@]+))?(/.*)?")


class OutputsCommit(Request):
    """Request to commit the outputs of a job to a branch of a dataset, in the transaction that publishes them."""

    dataset: DatasetName
    branch: RefName = MAIN
    folder: CollectionPath | None = Field(
        None,
        description="Folder of the dataset that receives the outputs; an output gets the same path below this folder "
        "as below `into`. Null: outputs in the project folder of the dataset get their paths relative to this "
        "folder, other outputs their paths in the project.",
    )
    message: Message = Field("", description="Message of the commit; empty: the kind and the id of the job.")
    replace: bool = Field(
        False,
        description="Also remove entries of the folder that are not among the outputs of this job, for example "
        "results of an earlier job. Only entries of the kinds that the job makes are removed.",
    )

    @classmethod
    def at(cls, place: str, **fields: Any) -> OutputsCommit:
        """Return the description of a commit of results to `place`, a text of the form `dataset[@branch][/folder]`.

        Raises `ValueError` for a text of another form.
        """
        match = _PLACE.fullmatch(place.strip())
        if match is None:
            raise ValueError(f"{place!r} names no branch of a dataset; write dataset[@branch][/folder]")
        folder = None if match[3] is None else match[3].strip("/")
        return cls(dataset=match[1], branch=match[2] or MAIN, folder=folder, **fields)

    @classmethod
    def of(cls, given: OutputsCommit | str | None) -> OutputsCommit | None:
        """Return a commit that is given as an object, or as text in the form that `at` accepts; None for None."""
        return cls.at(given) if isinstance(given, str) else given


class CommitOptions(Options):
    """Options of commands that submit jobs, for the commit of the results to a branch of a dataset."""

    commit_to: str | None = Field(
        None,
        description="Commit the results to a branch when the job ends: dataset[@branch][/folder]. Absent: "
        "no commit is made.",
    )
    commit_message: str | None = Field(
        None, description="Message of the commit; absent: the kind and the id of the job."
    )
    commit_replace: bool = Field(
        False,
        description="In the same commit, remove entries of the folder that are not among the results of this job.",
    )

    def commit(self) -> OutputsCommit | None:
        """Return the requested commit, or None if the options name no branch.

        Raises `ValueError` if `commit_to` is malformed, or if it is missing although another option is given.
        """
        if self.commit_to is not None:
            return OutputsCommit.at(self.commit_to, message=self.commit_message or "", replace=self.commit_replace)
        if self.commit_message is not None or self.commit_replace:
            raise ValueError("--commit-message and --commit-replace need --commit-to, which names the branch")
        return None


class CommitConflict(Answer):
    """Reason why the outputs of a job that has succeeded are not on the branch that the submission names."""

    code: Literal["paths-changed", "too-many-changes", "path-too-long", "too-many-refs"]
    detail: str
    branch: str | None = Field(
        None, description="Branch that has the outputs instead; null: the outputs are in no commit."
    )
    paths: tuple[str, ...] = Field((), description=f"Paths in conflict, at most {MOST_LISTED}.")
    count: int = Field(0, description="Number of paths in conflict.")


class JobCommit(Answer):
    """Commit of the outputs of a job to a branch: the plan until the job ends, then the result."""

    dataset: str
    branch: str
    folder: str = Field(description="Folder of the dataset that receives the outputs.")
    message: str
    replace: bool
    base: str | None = Field(
        description="Newest commit of the branch at the time when the inputs of the job were fixed. Later "
        "changes by others are not overwritten. Null: the branch had no commit."
    )
    digest: str | None = Field(
        None, description="Commit that has the outputs; null before the end of the job, and if no entry changed."
    )

"""Scratch project: a project with a tiny file and a token, removed at the end of a test."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from marey_client.blobs import Blobs
from marey_client.errors import Conflict, Forbidden, NotFound
from marey_client.marey import Marey
from marey_client.project import ProjectHandle
from marey_schemas.access import NewToken, ProjectCreate, Scope, TokenCreate
from marey_schemas.queue.jobs import JobState

PREFIX = "bench-"
LABEL = "bench"
"""Name of the label that jobs of a scratch project require, so that only workers of the test claim the jobs."""
TOKEN_LIFETIME_S = 6 * 3600
"""Lifetime of the test's token in seconds, in case the test is killed before it can revoke the token."""
CANCELS_AT_ONCE = 4
KIND = "import"
"""Kind of the jobs of a test: an import of one tiny clip, for which workers need little time."""
CLIP_NAME = "clip.bvh"

CLIP = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Chest
  {
    OFFSET 0 10 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 10 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0166667
0 90 0 0 0 0 0 0 0
0 90 1 0 0 0 0 5 0
"""
"""Clip of two joints and two frames, as a BVH file."""
UNIT_SCALE_M = 0.01
"""Unit of length of the file, in metres."""


@dataclass(frozen=True)
class Scratch:
    """A scratch project, and the digest of the file with its clip.

    `token` can submit and claim jobs of this project only, so workers that use it never get a job of another project.
    """

    marey: Marey
    project: ProjectHandle
    digest: str
    token: str

    @property
    def url(self) -> str:
        """The address of the server."""
        return self.marey.transport.url

    @property
    def labels(self) -> dict[str, str]:
        """The labels of jobs that only workers of this test claim."""
        return {LABEL: self.project.name}

    def job(self, *, own_workers: bool, into: str = "") -> dict[str, Any]:
        """Return the request for a job that imports the clip into the folder `into`, as a dict.

        With `own_workers`, only the workers of this test claim the job; otherwise, the server's other workers do.
        """
        return {
            "kind": KIND,
            "params": {"files": [{"name": CLIP_NAME, "blob": self.digest}], "unit_scale_m": UNIT_SCALE_M},
            "into": into,
            "cache": "off",
            "labels": self.labels if own_workers else {},
        }


@contextmanager
def scratch_project(marey: Marey) -> Iterator[Scratch]:
    """Create a scratch project, yield it, and remove it at the end of the `with` block, also after an error or Ctrl-C.

    Its jobs that have not ended are cancelled, its token is revoked, and the project is deleted. Raises
    `MareyError` if the caller may not create projects, or may not create a token with the scope `work`.
    """
    project = marey.create_project(ProjectCreate(name=f"{PREFIX}{secrets.token_hex(6)}", title="Test of the server"))
    token: str | None = None
    try:
        made = _make_token(marey, project.name)
        token = made.id
        digest = Blobs(marey.transport.with_token(made.secret)).put(CLIP.encode("ascii"))
        yield Scratch(marey, project, digest, made.secret)
    finally:
        _remove(marey, project, token)


def _make_token(marey: Marey, project: str) -> NewToken:
    scopes = tuple(f"{scope}!project={project}" for scope in (Scope.READ, Scope.WRITE, Scope.JOBS, Scope.WORK))
    wanted = TokenCreate(name=project, scopes=scopes, expires_in_s=TOKEN_LIFETIME_S)
    try:
        return marey.tokens.create(wanted)
    except Forbidden as error:
        error.add_note("the test needs a token that may also claim jobs; `marey login` stores one")
        raise


def _remove(marey: Marey, project: ProjectHandle, token: str | None) -> None:
    """Revoke the token, cancel the jobs, and delete the project; each step even if an earlier one fails."""
    try:
        if token is not None:
            marey.tokens.revoke(token)
    finally:
        try:
            _cancel_jobs(marey, project)
        finally:
            with suppress(NotFound):  # somebody else has deleted it
                project.delete()


def _cancel_jobs(marey: Marey, project: ProjectHandle) -> None:
    """Cancel all jobs of a project that have not ended, because they would count in the caller's quota."""
    with ThreadPoolExecutor(CANCELS_AT_ONCE) as pool:
        for state in (one for one in JobState if not one.terminal):
            jobs = [job.id for job in project.jobs(filters={"state": state})]
            list(pool.map(lambda job: _cancel(marey, job), jobs))


def _cancel(marey: Marey, job: str) -> None:
    with suppress(Conflict, NotFound):  # it has ended in the meantime
        marey.jobs.cancel(job)

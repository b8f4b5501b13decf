"""Handles of submitted jobs: wait for the end with a progress bar, and get the results as handles of items."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import PrivateAttr

from marey_client.arguments import checks_arguments
from marey_client.jobs import Jobs, OnProgress
from marey_client.progress import is_shown, progress, show_progress
from marey_client.project_items import ProjectItems
from marey_schemas.queue.jobs import Job


@checks_arguments
class JobHandle(Job):
    """Job in the state in which it was read; its methods send requests."""

    _items: ProjectItems = PrivateAttr()

    @classmethod
    def of(cls, job: Job, items: ProjectItems) -> JobHandle:
        """Return a handle of a job of a project."""
        handle = cls.model_construct(job.model_fields_set, **dict(job))
        handle._items = items
        return handle

    def __repr__(self) -> str:
        done = "" if self.progress is None or self.state.terminal else f", {self.progress.done:g} done"
        return f"<job {self.kind} {self.id} {self.state}{done}>"

    __str__ = __repr__

    @property
    def _jobs(self) -> Jobs:
        return Jobs(self._items.transport)

    def refresh(self) -> JobHandle:
        """Read the job again; return a handle of its present state."""
        return self.of(self._jobs.get(self.id), self._items)

    def wait(
        self,
        *,
        timeout_s: float | None = None,
        shown: bool | None = None,
        on_progress: OnProgress | None = None,
        require_success: bool = True,
    ) -> JobHandle:
        """Wait until the job has ended; return a handle of its final state.

        A progress bar is shown on terminals and in notebooks; `shown` overrides this. Interrupting the wait does not
        stop the job. Raises the errors of `Jobs.wait`.
        """
        with progress(shown) as advance:

            def note(now: Job) -> None:
                show_progress(now, advance)
                if on_progress is not None:
                    on_progress(now)

            followed = is_shown(shown) or on_progress is not None
            ended = self._jobs.wait(
                self.id,
                timeout_s=timeout_s,
                on_progress=note if followed else None,  # without it, one request waits for long
                require_success=require_success,
            )
        return self.of(ended, self._items)

    def outputs(self) -> Iterator[Any]:
        """Yield handles of the items that the job created, such as `ClipHandle`, at their newest revisions.

        Items that have been purged are left out.
        """
        for one in self._jobs.outputs(self.id):
            if not one.purged:
                yield self._items.items(one.kind).get(one.item)

    def log(self, *, follow: bool = False) -> Iterator[bytes]:
        """Yield the log of the job's attempts, piece by piece; with `follow`, continue until the job has ended."""
        return self._jobs.log(self.id, follow=follow)

    def cancel(self) -> JobHandle:
        """Ask the job to stop; a job that does not run yet is cancelled at once."""
        return self.of(self._jobs.cancel(self.id), self._items)

"""Suggestions for parameters: fixed words, or names that the server lists."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Any, NamedTuple

from marey_client.cli.completion.asking import MOST_ENTRIES, ListClient, ListRequest
from marey_schemas.kinds import Kind

MOST_LISTED = 1000
JOBS_OF_PROJECT = 20
MOST_PROJECTS_OF_JOBS = 20


class Suggestion(NamedTuple):
    """Suggestion to the user: the text that replaces the typed word, and a remark that some shells show beside it."""

    text: str
    remark: str = ""


@dataclass(frozen=True)
class Typed:
    """Part of the command line to complete: the beginning of a word, the parameters before it, and global options."""

    start: str
    values: Mapping[str, Any]
    server: str | None = None
    token_file: str | None = None

    @cached_property
    def lists(self) -> ListClient:
        """The reader of lists of the server, opened when it is first needed."""
        return ListClient.opened(self.server, self.token_file)

    def value(self, *names: str) -> str:
        """Return the value of the first of the named parameters that has a value; the empty text if none has."""
        for name in names:
            value = self.values.get(name)
            if isinstance(value, (list, tuple)):
                value = value[0] if value else None
            if value:
                return str(value)
        return ""


How = Callable[[Typed], Iterable[Suggestion]]
"""Function that returns suggestions; the caller drops suggestions that do not begin with the typed text."""


def one_of(*words: str) -> How:
    """Return a function that suggests the given words."""
    return lambda _: map(Suggestion, words)


def listed_in(declared: str, *more: str) -> How:
    """Return a function that suggests words: those of a list, an enumeration or a function, declared as `module:name`.

    A function is called without arguments. The module is imported only if the words are needed. `more` are further
    words.
    """
    return lambda _: map(Suggestion, (*_words(declared), *more))


def several_listed_in(declared: str) -> How:
    """Return a function that completes the word after the last comma of a list; `declared` is that of `listed_in`."""

    def how(typed: Typed) -> Iterator[Suggestion]:
        before, comma, _ = typed.start.rpartition(",")
        taken = before.split(",")
        yield from (Suggestion(f"{before}{comma}{word}") for word in _words(declared) if word not in taken)

    return how


def _words(declared: str) -> tuple[str, ...]:
    module, _, name = declared.partition(":")
    words: Any = getattr(import_module(module), name)
    return tuple(map(str, words if isinstance(words, Iterable) else words()))


def nothing(_: Typed) -> tuple[Suggestion, ...]:
    """Suggest nothing, because the parameter is a name that the user makes up."""
    return ()


def any_of(*hows: How) -> How:
    """Return a function that returns the suggestions of several functions."""
    return lambda typed: (one for how in hows for one in how(typed))


# -- projects and paths in them --


def projects(typed: Typed) -> Iterator[Suggestion]:
    """Complete the name of a project."""
    for one in typed.lists.entries("projects", sort="name", limit=MOST_LISTED):
        yield Suggestion(one["name"], one.get("title") or "")


def places(*kinds: Kind) -> How:
    """Return a function that completes an address such as `lab/raw/walk`, one name at a time; folders end with `/`.

    Only items of the given kinds are suggested.
    """

    def how(typed: Typed) -> Iterator[Suggestion]:
        project, slash, path = typed.start.partition("/")
        if not slash:
            return (Suggestion(f"{one.text}/", one.remark) for one in projects(typed))
        return (Suggestion(f"{project}/{one.text}", one.remark) for one in _paths(typed.lists, project, path, kinds))

    return how


def paths(*kinds: Kind) -> How:
    """Return a function that completes a path in the project of the command, one name at a time.

    Only items of the given kinds are suggested; without kinds, only folders.
    """

    def how(typed: Typed) -> Iterator[Suggestion]:
        project = _project_of(typed)
        return _paths(typed.lists, project, typed.start, kinds) if project else iter(())

    return how


def _paths(lists: ListClient, project: str, path: str, kinds: Sequence[Kind]) -> Iterator[Suggestion]:
    """Yield folders, then items, in the parent folder of `path` whose names begin with the last name of `path`."""
    folder, slash, name = path.rpartition("/")
    among: dict[str, str | None] = {"directly_in": folder, "name": f"{name}*" if name else None}
    below, *items = lists.ask(
        [
            ListRequest.of("projects", project, "collections", **among),
            *(ListRequest.of("projects", project, kind.plural, **among, sort="name", fields="name") for kind in kinds),
        ]
    )
    yield from (Suggestion(f"{one['path']}/") for one in below)
    for kind, found in zip(kinds, items, strict=True):
        yield from (Suggestion(f"{folder}{slash}{one['name']}", kind.value) for one in found)


_PROJECTS = ("project", "project_name")
_PLACES = ("place", "places", "sources", "takes", "evaluation", "address", "clip", "before", "example")


def _project_of(typed: Typed) -> str:
    """Return the project that an earlier parameter names, alone or as the start of an address; empty if none does."""
    return typed.value(*_PROJECTS) or typed.value(*_PLACES).strip("/").partition("/")[0]


# -- versions of datasets --


def datasets(typed: Typed) -> Iterator[Suggestion]:
    """Complete a dataset: project/dataset."""
    project, slash, _ = typed.start.partition("/")
    if not slash:
        return (Suggestion(f"{one.text}/", one.remark) for one in projects(typed))
    found = typed.lists.entries("projects", project, "datasets")
    return (Suggestion(f"{project}/{one['name']}", "dataset") for one in found)


def versions(typed: Typed) -> Iterator[Suggestion]:
    """Complete a version of a dataset: project/dataset@branch or project/dataset@tag."""
    dataset, at, _ = typed.start.partition("@")
    if not at:
        return datasets(typed)
    return (Suggestion(f"{dataset}@{one.text}", one.remark) for one in _refs(typed.lists, dataset))


def refs(typed: Typed) -> Iterator[Suggestion]:
    """Complete a branch or a tag of the dataset of the command."""
    return _refs(typed.lists, typed.value("place").partition("@")[0])


def branches(typed: Typed) -> Iterator[Suggestion]:
    """Complete a branch of the dataset of the command."""
    return (one for one in refs(typed) if one.remark == "branch")


def entries(typed: Typed) -> Iterator[Suggestion]:
    """Complete the path of an entry in the version of the command, one name at a time; folders end with `/`."""
    place, _, version = typed.value("place").partition("@")
    project, _, name = place.strip("/").partition("/")
    folder, slash, _ = typed.start.rpartition("/")
    if not project or not name:
        return
    asked = {"version": version or None, "path": folder or None, "limit": MOST_LISTED}
    seen: dict[str, Suggestion] = {}
    for one in typed.lists.entries("projects", project, "datasets", name, "entries", **asked):
        step, below, _ = one["path"].removeprefix(f"{folder}{slash}").partition("/")
        text = f"{folder}{slash}{step}{below}"
        seen.setdefault(text, Suggestion(text, "" if below else one["kind"]))
    yield from seen.values()


def proposals(typed: Typed) -> Iterator[Suggestion]:
    """Complete the number of a proposal to the dataset of the command."""
    project, _, name = typed.value("place").strip("/").partition("/")
    if project and name:
        for one in typed.lists.entries("projects", project, "datasets", name, "proposals"):
            yield Suggestion(str(one["number"]), f"{one['state']}: {one['title']}")


def commit_targets(typed: Typed) -> Iterator[Suggestion]:
    """Complete a dataset of the project of the command; after `@`, a branch of this dataset."""
    project = _project_of(typed)
    dataset, at, _ = typed.start.partition("@")
    if at:
        found = _refs(typed.lists, f"{project}/{dataset}")
        return (Suggestion(f"{dataset}@{one.text}", one.remark) for one in found if one.remark == "branch")
    return iter(in_project("datasets")(typed))


def _refs(lists: ListClient, dataset: str) -> Iterator[Suggestion]:
    project, _, name = dataset.strip("/").partition("/")
    if project and name and "/" not in name:
        for one in lists.entries("projects", project, "datasets", name, "refs"):
            yield Suggestion(one["name"], one["kind"])


def places_or_versions(*kinds: Kind) -> How:
    """Complete an address of items or folders; after `@`, a version of a dataset."""
    of_items = places(*kinds)

    def how(typed: Typed) -> Iterator[Suggestion]:
        _, _, path = typed.start.partition("/")
        yield from of_items(typed)
        if "@" in path and "/" not in path:
            yield from versions(typed)
        elif typed.start.count("/") == 1:
            yield from datasets(typed)

    return how


# -- jobs, users and other objects --


def jobs(*states: str) -> How:
    """Complete the id of a recent job of the project, or of all projects; with `states`, only jobs in these states."""

    def how(typed: Typed) -> Iterator[Suggestion]:
        lists = typed.lists
        project = typed.value("project")
        of_projects = ListRequest.of("projects", sort="-updated_at")
        names = [project] if project else [one["name"] for one in lists.ask([of_projects])[0]]
        most = MOST_ENTRIES if typed.start else JOBS_OF_PROJECT
        wanted = {"state": ",".join(states) or None, "limit": most}
        found = lists.ask([ListRequest.of("projects", one, "jobs", **wanted) for one in names[:MOST_PROJECTS_OF_JOBS]])
        newest = sorted((job for some in found for job in some), key=lambda job: job["created_at"], reverse=True)
        yield from (Suggestion(job["id"], f"{job['kind']}, {job['state']}") for job in newest)

    return how


def job_kinds(typed: Typed) -> Iterator[Suggestion]:
    """Complete the kind of a job."""
    return (
        Suggestion(one["name"], one["description"].partition(".")[0])
        for one in typed.lists.entries("job-kinds", limit=None)
    )


def users(typed: Typed) -> Iterator[Suggestion]:
    """Complete the name of a user; the server lists users for administrators only."""
    return (Suggestion(one["name"], one.get("display_name") or "") for one in typed.lists.entries("users"))


def members(typed: Typed) -> Iterator[Suggestion]:
    """Complete the name of a member of the project of the command."""
    if project := _project_of(typed):
        yield from (Suggestion(one["user"]) for one in typed.lists.entries("projects", project, "members", limit=None))


def in_project(plural: str, field: str = "name", remark: str = "") -> How:
    """Complete a field of the objects that a project lists, such as its scripts, schedules or webhooks."""

    def how(typed: Typed) -> Iterator[Suggestion]:
        if project := _project_of(typed):
            for one in typed.lists.entries("projects", project, plural):
                yield Suggestion(str(one[field]), str(one.get(remark) or ""))

    return how

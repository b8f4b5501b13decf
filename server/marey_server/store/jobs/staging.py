"""Staging of outputs during an attempt, and their publication when it completes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import and_, bindparam, delete, func, insert, select, tuple_, update

from marey_schemas.kinds import PARTS, Kind
from marey_schemas.names import is_digest
from marey_schemas.problems import FieldError
from marey_schemas.queue.facets import ItemFacets
from marey_schemas.queue.jobs import ItemInput
from marey_schemas.queue.worker_protocol import StagedOutput
from marey_server import faults
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.prepared_documents import PreparedDocument, prepare_document
from marey_server.store import blobs, documents
from marey_server.store.database.prepared import Prepared
from marey_server.store.folder_roles.rights import rights_of_author
from marey_server.store.items.drafts import Draft, StoredDocument
from marey_server.store.items.facets import StoredFacets, publish_facets, stored_facets, with_revisions
from marey_server.store.items.publishing import publish
from marey_server.store.jobs.fencing import lock_held_job, require_attempt
from marey_server.store.jobs.inputs import PinnedInputs
from marey_server.store.projects import find_by_id
from marey_server.store.tables import document, job, staged_output
from marey_server.store.transaction import Transaction, in_lists

MOST_STAGED = 20_000

StagedDraft = dict[str, Any]
"""Draft as an attempt stages it: kind, name, collection below `into`, tags, `reuse`, sources, digests of the parts."""

_FACETS = ""
"""Name of the entry in the table of staged drafts that contains the facets of an attempt (numbers about inputs)."""


@dataclass(frozen=True, slots=True)
class PreparedOutput:
    """Output that is ready to be staged: its documents are checked and encoded."""

    output: StagedOutput
    parts: Mapping[str, PreparedDocument]


def prepare_output(output: StagedOutput) -> PreparedOutput:
    """Check and encode the documents of an output.

    Raises `InvalidProblem` if the kind has no such part, or a document is not valid.
    """
    specs = PARTS[output.kind]
    unknown = [part for part in output.parts if part not in specs]
    if unknown:
        detail = f"A {output.kind} has no part {unknown[0]!r}; it has {', '.join(specs)}."
        raise InvalidProblem(
            detail, code="no-part", errors=[FieldError(pointer=f"/{unknown[0]}", code="no-part", detail=detail)]
        )
    parts = {part: prepare_document(tree, schema=specs[part].schema) for part, tree in output.parts.items()}
    return PreparedOutput(output, parts)


def stage(
    tx: Transaction, job_id: str, fence: int, outputs: Sequence[PreparedOutput], facets: Sequence[ItemFacets] = ()
) -> int:
    """Store outputs until the attempt completes; they replace staged outputs of the same names.

    Returns the number of all outputs that the attempt has staged so far. `facets`, unless empty, replace all facets
    that the attempt staged before. Raises `LeaseLostProblem` if the attempt does not hold the job. Raises
    `InvalidProblem` for sources that are not inputs of the job, for two `outputs` of the same name, and for more than
    `MOST_STAGED` outputs of the attempt. Raises the errors of `stored_facets`, too.
    """
    require_attempt(tx.principal, job_id, fence)
    held = lock_held_job(tx, job_id, fence, job.c.inputs, job.c.kind, job.c.project_id)
    if facets:
        _stage_facets(tx, job_id, fence, stored_facets(tx, held, facets))
    return _stage_outputs(tx, job_id, fence, outputs, held.inputs)


def _stage_facets(tx: Transaction, job_id: str, fence: int, facets: StoredFacets) -> None:
    row = {"job_id": job_id, "fence": fence, "name": _FACETS, "position": -1}
    of_attempt = (staged_output.c.job_id == job_id, staged_output.c.fence == fence)
    tx.execute(delete(staged_output).where(*of_attempt, staged_output.c.name == _FACETS))
    tx.execute(insert(staged_output).values(**row, draft={"sources": {}, "parts": {}, "facets": facets}))


def _stage_outputs(
    tx: Transaction, job_id: str, fence: int, outputs: Sequence[PreparedOutput], pins: PinnedInputs
) -> int:
    names = [one.output.name for one in outputs]
    if len(set(names)) != len(names):
        twice = Counter(names).most_common(1)[0][0]
        raise InvalidProblem(
            f"Two results in the request have the name {twice!r}; give each result another name.",
            code="duplicate-output",
        )
    of_attempt = (staged_output.c.job_id == job_id) & (staged_output.c.fence == fence)
    last = tx.execute(select(func.max(staged_output.c.position)).where(of_attempt)).scalar()
    replaced = tx.execute(
        delete(staged_output)
        .where(of_attempt, staged_output.c.name.in_(names))
        .returning(staged_output.c.name, staged_output.c.position)
    )
    places = {row.name: row.position for row in replaced}
    position = -1 if last is None else last
    rows = []
    for one in outputs:
        if one.output.name not in places:
            position += 1
            places[one.output.name] = position
        rows.append(
            {
                "job_id": job_id,
                "fence": fence,
                "name": one.output.name,
                "position": places[one.output.name],
                "draft": _staged_draft(one, pins),
            }
        )
    if position >= MOST_STAGED:
        raise InvalidProblem(f"An attempt can stage at most {MOST_STAGED} results.", code="too-many")
    documents.store_documents(tx, (content for one in outputs for content in one.parts.values()))
    if rows:
        tx.execute(insert(staged_output), rows)
    faults.point("stage.before_commit")
    return position + 1


def _staged_draft(prepared: PreparedOutput, pins: PinnedInputs) -> StagedDraft:
    output = prepared.output
    return {
        "kind": output.kind.value,
        "item_name": output.item_name,
        "collection": output.collection,
        "tags": list(output.tags),
        "reuse": output.reuse,
        "same_skeleton": output.same_skeleton,
        "sources": _pinned_sources(output, pins),
        "parts": {part: content.digest for part, content in prepared.parts.items()},
    }


def _pinned_sources(output: StagedOutput, pins: PinnedInputs) -> dict[str, list[list[Any]]]:
    """Return the inputs from which an output was made, by name of the input, as pairs of item and revision.

    These are the inputs that the output names as its sources; if it names none, they are all inputs. Raises
    `InvalidProblem` for a source that is no input.
    """
    if not output.sources:
        return {role: [[pin["item"], pin["revision"]] for pin in many] for role, many in pins.items()}
    return {role: [_pinned_source(role, source, pins) for source in named] for role, named in output.sources.items()}


def _pinned_source(role: str, source: ItemInput, pins: PinnedInputs) -> list[Any]:
    given = [pin["revision"] for pin in pins.get(role, ()) if pin["item"] == source.item]
    if source.revision is None and len(given) == 1:
        return [source.item, given[0]]
    if source.revision in given:
        return [source.item, source.revision]
    asked = "" if source.revision is None else f" at revision {source.revision}"
    known = f"; the job reads {', '.join(f'revision {one}' for one in given)}" if given else ""
    raise InvalidProblem(
        f"A result names the source {source.item}{asked}, which is not in the input {role!r} of the job{known}.",
        code="no-input",
    )


# -- publishing -------------------------------------------------------------------------------------------------------


_BY_ATTEMPTS = and_(
    staged_output.c.job_id.in_(bindparam("jobs", expanding=True)),  # for pairs alone SQLite would scan the table
    tuple_(staged_output.c.job_id, staged_output.c.fence).in_(bindparam("attempts", expanding=True)),
)
_STAGED = Prepared(select(staged_output).where(_BY_ATTEMPTS).order_by(staged_output.c.job_id, staged_output.c.position))
_DROP_STAGED = Prepared(delete(staged_output).where(_BY_ATTEMPTS))


def staged_drafts(
    tx: Transaction, attempts: Collection[tuple[str, int]]
) -> dict[tuple[str, int], dict[str, StagedDraft]]:
    """Return the drafts that attempts staged, by name, in the order of staging.

    An attempt is given by the id of its job, and by its fence (the number of the claim that started it).
    """
    drafts: dict[tuple[str, int], dict[str, StagedDraft]] = {}
    for row in tx.run(_STAGED, _of_attempts(attempts)):
        drafts.setdefault((row.job_id, row.fence), {})[row.name] = row.draft
    return drafts


def renew_documents(tx: Transaction, drafts: Mapping[str, StagedDraft]) -> bool:
    """Reset the age of documents that an earlier job staged, so that garbage collection keeps them.

    Returns whether all of them are still stored.
    """
    wanted = sorted({digest for draft in drafts.values() for digest in draft["parts"].values()})
    kept = 0
    for some in in_lists(wanted):
        page = document.c.digest.in_(some)
        kept += tx.execute(update(document).where(page).values(created_us=tx.now_us)).rowcount
    return kept == len(wanted)


def drop_staged(tx: Transaction, attempts: Collection[tuple[str, int]]) -> None:
    """Delete the drafts of attempts, each given by the id of its job and its fence (number of the claim).

    Called for attempts that did not succeed, and for attempts whose results no other job can share.
    """
    tx.run(_DROP_STAGED, _of_attempts(attempts))


def drop_staged_facets(tx: Transaction, job_ids: Sequence[str]) -> None:
    """Delete the facets that the attempts of jobs staged; published facets of the jobs stay."""
    for some in in_lists(job_ids):
        tx.execute(delete(staged_output).where(staged_output.c.job_id.in_(some), staged_output.c.name == _FACETS))


def _of_attempts(attempts: Collection[tuple[str, int]]) -> dict[str, Any]:
    """Return the parameters of the condition `_BY_ATTEMPTS`, which selects the staged drafts of attempts.

    An attempt is given by the id of its job and its fence (number of the claim).
    """
    return {"jobs": [job_id for job_id, _ in attempts], "attempts": list(attempts)}


def with_inputs(drafts: Mapping[str, StagedDraft], theirs: PinnedInputs, ours: PinnedInputs) -> dict[str, StagedDraft]:
    """Return drafts that an identical job has staged, rewritten as drafts of this job.

    The two jobs may have read different revisions with the same content: `theirs` are the inputs of the other job,
    `ours` those of this job. In the sources and facets of each draft, a revision from `theirs` is replaced by the
    revision at the same position in `ours`.
    """
    revisions = {
        (role, their["item"], their["revision"]): our["revision"]
        for role, many in theirs.items()
        for their, our in zip(many, ours[role], strict=True)
    }
    of_items = {(item, theirs): ours for (_, item, theirs), ours in revisions.items()}
    return {
        name: draft
        | {
            "facets": with_revisions(draft.get("facets", []), of_items),
            "sources": {
                role: [[item, revisions[role, item, revision]] for item, revision in pairs]
                for role, pairs in draft["sources"].items()
            },
        }
        for name, draft in drafts.items()
    }


def number_measured(drafts: Mapping[str, StagedDraft]) -> int:
    """Return the number of revisions about which the drafts of a job state facets."""
    return len(drafts[_FACETS]["facets"]) if _FACETS in drafts else 0


def publish_drafts(tx: Transaction, row: Any, drafts: Mapping[str, StagedDraft]) -> list[dict[str, Any]]:
    """Publish the drafts and the facets of a job with the present rights of its author; return the published outputs.

    Raises `ForbiddenProblem` if the author may not write to a folder of the results. `row` has the columns `id`,
    `project_id`, `into_path`, `author_id` and `message` of the job.
    """
    if _FACETS in drafts:
        publish_facets(tx, row.project_id, drafts[_FACETS]["facets"])
    results = {name: draft for name, draft in drafts.items() if name != _FACETS}
    if not results:
        return []
    project = find_by_id(tx, row.project_id)
    published = publish(
        tx,
        project,
        [_draft(name, draft, row) for name, draft in results.items()],
        author_id=row.author_id,
        rights=rights_of_author(tx, project, row.author_id),
        job_id=row.id,
    )
    return [
        {
            "name": one.name,
            "item": one.item,
            "kind": one.kind.value,
            "revision": one.revision,
            "created": one.created,
            **({"skeleton_changed": True} if one.skeleton_changed else {}),
        }
        for one in published
    ]


def _draft(name: str, draft: StagedDraft, row: Any) -> Draft:
    return Draft(
        name_in_batch=name,
        kind=Kind(draft["kind"]),
        item_name=draft["item_name"],
        parts={part: StoredDocument(digest) for part, digest in draft["parts"].items()},
        collection="/".join(filter(None, (row.into_path, draft["collection"]))),
        tags=draft["tags"],
        sources={role: [(item, revision) for item, revision in pairs] for role, pairs in draft["sources"].items()},
        reuse=draft["reuse"],
        message=row.message,
        same_skeleton=draft.get("same_skeleton", False),  # earlier versions did not store it
    )


# -- files ------------------------------------------------------------------------------------------------------------


def named_blobs(tree: Any) -> Iterator[str]:
    """Yield the digests in all members named `blob`, at any depth of `tree`: parameters, or a result."""
    if isinstance(tree, Mapping):
        for name, value in tree.items():
            if name == "blob" and isinstance(value, str) and is_digest(value):
                yield value
            else:
                yield from named_blobs(value)
    elif isinstance(tree, (list, tuple)):
        for value in tree:
            yield from named_blobs(value)


def keep_named_blobs(tx: Transaction, job_id: str, digests: set[str]) -> None:
    """Keep the blobs that a job names, and let readers of the project read them; garbage collection spares them.

    Raises `ConflictProblem` (`missing-blobs`) for blobs that the caller has not sent and may not read.
    """
    if not digests:
        return
    lacking = digests - blobs.readable(tx, digests)
    if lacking:
        detail = "The job refers to blobs that the server does not have; upload them first."
        raise ConflictProblem(detail, code="missing-blobs", context={"missing": sorted(lacking)})
    blobs.keep_for_job(tx, job_id, digests)

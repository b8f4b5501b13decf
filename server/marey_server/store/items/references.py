"""References from documents to items: to other drafts of the same write, or to existing revisions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy import select

from marey_schemas.documents.originals import content_digest
from marey_schemas.kinds import Kind
from marey_schemas.problems import FieldError
from marey_schemas.wording import counted
from marey_server.errors import InvalidProblem
from marey_server.store.items.drafts import Published
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import document, item, revision_part
from marey_server.store.transaction import Transaction

Tree = dict[str, Any]


def outputs_in(tree: Any) -> Iterator[str]:
    """Yield the names of the drafts that a document refers to as `{"output": name}`."""
    if isinstance(tree, Mapping):
        if tree.keys() == {"output"} and isinstance(tree["output"], str):
            yield tree["output"]
        else:
            for member in tree.values():
                yield from outputs_in(member)
    elif isinstance(tree, (list, tuple)):
        for member in tree:
            yield from outputs_in(member)


def with_model_digest(tree: Tree, digest: str | None) -> Tree:
    """Return the sample tree with `digest` in its member `model_digest`, if that refers to the model of the same draft.

    The tree is unchanged if the member is a digest already, or if `digest` is None.
    """
    if digest is None or isinstance(tree["model_digest"], str):
        return tree
    return {**tree, "model_digest": digest}


def with_imported_content(tree: Tree, before: Tree) -> Tree:
    """Return the graph `tree`; if it is still as it was imported, update the content digest in its member `original`.

    `before` is the graph with references to drafts; in `tree`, revisions replace these references. If `original` has
    the content digest of `before`, the graph was not edited, and `original` gets the content digest of `tree`.
    """
    original = tree.get("original")
    if original is None or original["content"] != content_digest("graph", before):
        return tree
    return {**tree, "original": {**original, "content": content_digest("graph", tree)}}


def in_order(names: Mapping[str, Sequence[str]]) -> list[str]:
    """Sort names so that each comes after the names it refers to; references to unknown names are ignored.

    Raises `InvalidProblem` for circular references.
    """
    ordered: dict[str, None] = {}
    for start in names:
        path = [start]
        while path:
            waiting = [name for name in names[path[-1]] if name in names and name not in ordered]
            if not waiting:
                ordered[path.pop()] = None
            elif waiting[0] in path:
                raise InvalidProblem(
                    f"The results refer to each other in a circle: {' -> '.join([*path, waiting[0]])}.",
                    code="output-cycle",
                )
            else:
                path.append(waiting[0])
    return list(ordered)


def resolved(tree: Any, done: Mapping[str, Published]) -> Any:
    """Return the document `tree` with each reference to a draft replaced by the revision published from the draft.

    `done` contains the published revisions by the name of the draft. References to other drafts are not replaced.
    """
    if isinstance(tree, Mapping):
        if tree.keys() == {"output"} and tree["output"] in done:
            published = done[tree["output"]]
            return {"item": published.item, "revision": published.revision}
        return {key: resolved(member, done) for key, member in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [resolved(member, done) for member in tree]
    return tree


class ReferenceCheck:
    """Check of the references in parts of items; looks up each revision once.

    With `to_deleted`, documents may refer to items that are deleted.
    """

    def __init__(self, tx: Transaction, project_row: ProjectRow, *, to_deleted: bool = False) -> None:
        self._tx = tx
        self._to_deleted = to_deleted
        self._project_id = project_row.id
        self._seen: dict[tuple[str, int, Kind, str], Tree] = {}

    def know(self, published: Published, bodies: Mapping[str, Tree]) -> None:
        """Remember the documents of a published revision, so that `require` need not read them from the database."""
        for part, body in bodies.items():
            self._seen[published.item, published.revision, published.kind, part] = body

    def require(self, kind: Kind, bodies: Mapping[str, Tree]) -> None:
        """Check the references in the new parts of an item.

        Raises `InvalidProblem` if a part refers to something that does not exist or does not fit the part.
        """
        if kind in (Kind.CLIP, Kind.PROCESSED) and "motion" in bodies:
            self._require_joints(bodies["motion"], "/motion")
        elif kind is Kind.MODEL:
            if "model" in bodies:
                self._require_joints(bodies["model"], "/model")
            if "tree" in bodies and not isinstance(bodies["tree"]["model_digest"], str):
                detail = "The request does not contain the model of the tree; give the digest of the part `model`."
                raise _invalid("/tree/model_digest", "no-part", detail)
        elif kind is Kind.ANNOTATION:
            self._require_frames(bodies["annotation"])
        elif kind is Kind.GRAPH:
            self._require_models(bodies["graph"])
        elif kind is Kind.STUDY:
            for number, motion in enumerate(bodies["study"]["motions"]):
                self._referred(motion["clip"], Kind.CLIP, "motion", f"/study/motions/{number}/clip")

    def _require_joints(self, motion: Tree, pointer: str) -> None:
        hierarchy = self._referred(motion["skeleton"], Kind.SKELETON, "hierarchy", f"{pointer}/skeleton")
        known = [joint["name"] for joint in hierarchy["joints"]]
        if sorted(known) != sorted(motion["joints"]):
            odd = sorted(set(known) ^ set(motion["joints"]))[:5]
            what = pointer.removeprefix("/")
            detail = f"The joints of the {what} and of its skeleton differ: {', '.join(odd) or 'a name occurs twice'}."
            raise _invalid(f"{pointer}/joints", "wrong-joints", detail)
        if known[0] in motion.get("translated_joints", ()):
            detail = (
                f"Remove the root {known[0]!r} from `translated_joints`: the poses already contain its translation."
            )
            raise _invalid(f"{pointer}/translated_joints", "root-translated", detail)

    def _require_frames(self, annotation: Tree) -> None:
        frames = self._referred(annotation["clip"], Kind.CLIP, "motion", "/annotation/clip")["poses"]["shape"][0]
        ends = [segment["end"] for segment in annotation.get("segments", ())]
        ends += [keyframe["frame"] + 1 for keyframe in annotation.get("keyframes", ())]
        if max(ends, default=0) > frames:
            detail = f"The clip has only {counted(frames, 'frame')}, but the annotation ends after {max(ends)} frames."
            raise _invalid("/annotation", "beyond-end", detail)

    def _require_models(self, graph: Tree) -> None:
        for action, group in graph["actions"].items():
            for name, node in group["primitives"].items():
                pointer = "/".join(("/graph/actions", _escaped(action), "primitives", _escaped(name), "model"))
                self._referred(node["model"], Kind.MODEL, "model", pointer)

    def _referred(self, ref: Tree, kind: Kind, part: str, pointer: str) -> Tree:
        """Return the document of the part `part` of the revision that `ref` names.

        Raises `InvalidProblem` if the project has no such revision. `pointer` is the place of the reference.
        """
        if "output" in ref:
            raise _invalid(
                pointer,
                f"no-{kind.value}",
                f"A document refers to the result {ref['output']!r}, which is not in this request.",
            )
        key = (ref["item"], ref["revision"], kind, part)
        if key not in self._seen:
            body = self._look_up(*key)
            if body is None:
                detail = f"There is no {kind.value} {ref['item']!r} at revision {ref['revision']} in this project."
                raise _invalid(pointer, f"no-{kind.value}", detail)
            self._seen[key] = body
        return self._seen[key]

    def _look_up(self, item_id: str, number: int, kind: Kind, part: str) -> Tree | None:
        """Return the document of a part, or None if it does not exist.

        The item is locked, so that it is not purged before this write ends.
        """
        statement = (
            select(document.c.body)
            .join(revision_part, revision_part.c.document_digest == document.c.digest)
            .join(item, item.c.id == revision_part.c.item_id)
            .where(
                item.c.id == item_id,
                item.c.project_id == self._project_id,
                item.c.kind == kind.value,
                item.c.purged_us.is_(None),
                revision_part.c.number == number,
                revision_part.c.part == part,
            )
            .with_for_update(read=True, key_share=True, of=item)
        )
        if not self._to_deleted:
            statement = statement.where(item.c.deleted_us.is_(None))
        body: Tree | None = self._tx.execute(statement).scalar()
        return body


def _escaped(name: str) -> str:
    """Return a name escaped as a part of a JSON Pointer."""
    return name.replace("~", "~0").replace("/", "~1")


def _invalid(pointer: str, code: str, detail: str) -> InvalidProblem:
    return InvalidProblem(detail, code=code, errors=[FieldError(pointer=pointer, code=code, detail=detail)])

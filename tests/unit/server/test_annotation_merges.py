"""Versions with a clip that two people have labelled: merges, cherry-picks, reverts, and commits of jobs."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import func, select, update
from tests.support.committing_desk import CommittingDesk
from tests.support.kept_rows import made_once
from tests.support.queue_desk import Desk, opened_desk
from tests.support.store_fixtures import motion_tree, skeleton_tree

from marey_schemas.datasets.checkouts import CheckoutRequest
from marey_schemas.datasets.commits import PutEntry
from marey_schemas.datasets.merges import (
    MOST_CONFLICTING_SEGMENTS,
    MergeAnswer,
    MergeRequest,
    PickRequest,
    Resolution,
    Side,
)
from marey_schemas.datasets.naming import RefCreate, RefKind
from marey_schemas.kinds import Kind
from marey_schemas.queue.worker_protocol import StagedOutput
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.store import datasets, fsck, items
from marey_server.store.database.connections import Database
from marey_server.store.datasets import merging
from marey_server.store.documents import load_body
from marey_server.store.items.drafts import Draft
from marey_server.store.items.revisions import read_part_digests
from marey_server.store.tables import document, holding, project, revision
from marey_server.store.transaction import Transaction

Segment = tuple[str, int, int]

BASE: list[Segment] = [("step", 0, 30), ("step", 60, 90)]
OURS: list[Segment] = [("left", 0, 30), ("step", 60, 90)]
THEIRS: list[Segment] = [("step", 0, 30), ("pause", 30, 60), ("step", 60, 90)]
BOTH: list[Segment] = [("left", 0, 30), ("pause", 30, 60), ("step", 60, 90)]
OTHERWISE: list[Segment] = [("right", 0, 30), ("step", 60, 90)]


class LabellingDesk(CommittingDesk):
    """Desk whose dataset has the annotation `labels` of the clip `walk`, and the branch `trial`."""

    def __init__(self, desk: Desk) -> None:
        super().__init__(desk, "gaits", "gaits")
        (rig,) = desk.publish(Draft("d", Kind.SKELETON, "rig", {"hierarchy": skeleton_tree()}))
        self.motion = motion_tree({"item": rig.item, "revision": 1}, frames=200)
        self.clip = self.publish_clip()
        self.label(BASE)
        self.write(datasets.create_ref, "lab", "gaits", RefCreate(name="trial", kind=RefKind.BRANCH, at="main"))

    def publish_clip(self, seed: int = 0, **info: Any) -> dict[str, Any]:
        """Publish a revision of the clip, and return a reference to it."""
        motion = self.motion if not seed else motion_tree(self.motion["skeleton"], frames=200, seed=seed)
        parts = {"motion": motion} | ({"info": {"schema": "marey/clip-info@1", **info}} if info else {})
        (made,) = self.desk.publish(Draft("d", Kind.CLIP, "walk", parts, "own"))
        return {"item": made.item, "revision": made.revision}

    def document(self, segments: list[Segment], **members: Any) -> dict[str, Any]:
        """Return the document of an annotation of the clip."""
        found = [dict(zip(("label", "start", "end"), one, strict=True)) for one in segments]
        return {"schema": "marey/annotation@1", "clip": self.clip, "segments": found, **members}

    def label(self, segments: list[Segment], branch: str = "main", path: str = "labels", **members: Any) -> None:
        """Commit an annotation with these segments."""
        parts = {"annotation": self.document(segments, **members)}
        (made,) = self.desk.publish(Draft("d", Kind.ANNOTATION, path, parts, "own"))
        self.change(PutEntry(path=path, item=made.item, revision=made.revision), branch=branch)

    def merge(self, **fields: Any) -> MergeAnswer:
        """Merge `trial` into `main`."""
        request = MergeRequest(version="trial", **fields)
        prepared = self.read(datasets.prepare_merge, "lab", "gaits", request)
        answer: MergeAnswer = self.write(datasets.record_merge, "lab", "gaits", request, prepared)
        return answer

    def pick(self, *, undo: bool = False, **fields: Any) -> MergeAnswer:
        """Cherry-pick a commit to `main`, or with `undo` revert it there."""
        request = PickRequest(**fields)
        prepared = self.read(datasets.prepare_pick, "lab", "gaits", request, undo=undo)
        answer: MergeAnswer = self.write(datasets.record_merge, "lab", "gaits", request, prepared)
        return answer

    def annotation(self, version: str = "main") -> Any:
        """Return the annotation in a version; its item may be deleted."""
        (entry,) = self.listed(version)
        assert entry.item is not None
        assert entry.revision is not None
        key = (entry.item, entry.revision)
        return self.read(load_body, self.read(read_part_digests, {key})[key]["annotation"])

    def labels(self, version: str = "main") -> list[Segment]:
        """Return the segments in a version."""
        found = self.annotation(version)["segments"]
        return [(one["label"], one["start"], one["end"]) for one in found]

    def rows(self) -> tuple[int, ...]:
        """Return how many revisions and documents are stored."""
        tables = (revision, document)
        counts = [select(func.count()).select_from(one) for one in tables]
        found: tuple[int, ...] = self.read(lambda tx: tuple(tx.execute(one).scalar_one() for one in counts))
        return found

    def problems(self) -> list[Any]:
        """Return the defects that the check of the store finds."""
        return list(fsck.check_store(self.desk.database))


def labelling_desk(database: Database) -> LabellingDesk:
    return LabellingDesk(opened_desk(database))


@pytest.fixture
def labelling(database: Database, test_kinds: None) -> LabellingDesk:
    """A project with one labelled clip, on SQLite and on Postgres."""
    return made_once(labelling_desk, database)


def test_labels_of_different_ranges_are_merged(labelling: LabellingDesk) -> None:
    labelling.label(OURS)
    labelling.label(THEIRS, "trial", keyframes=[{"label": "contact", "frame": 12}])
    assert labelling.merge().commit is not None
    assert labelling.annotation() == labelling.document(BOTH, keyframes=[{"label": "contact", "frame": 12}])
    assert labelling.problems() == []


def test_a_preview_stores_nothing_and_a_repeated_merge_makes_one_commit(labelling: LabellingDesk) -> None:
    labelling.label(OURS)
    labelling.label(THEIRS, "trial")
    before, head = labelling.rows(), labelling.head()
    preview = labelling.merge(preview=True)
    assert (preview.changes, preview.conflict_count, labelling.rows(), labelling.head()) == (1, 0, before, head)
    first = labelling.merge(write_id="12345678")
    assert labelling.rows() == tuple(count + 1 for count in before)
    assert labelling.merge(write_id="12345678").commit == first.commit
    assert labelling.rows() == tuple(count + 1 for count in before)


@pytest.mark.parametrize("preview", [True, False])
def test_a_merge_that_combines_too_many_entries_is_refused(
    labelling: LabellingDesk, monkeypatch: pytest.MonkeyPatch, preview: bool
) -> None:
    monkeypatch.setattr(merging, "MOST_COMBINED", 0)
    labelling.label(OURS)
    labelling.label(THEIRS, "trial")
    head = labelling.head()
    with pytest.raises(InvalidProblem) as refused:
        labelling.merge(preview=preview)
    assert (refused.value.error_code, labelling.head()) == ("too-many-combined", head)


def test_a_merge_that_gives_the_labels_of_one_side_stores_no_further_revision(labelling: LabellingDesk) -> None:
    labelling.label(BOTH)
    labelling.label([("left", 0, 30), ("step", 60, 90)], "trial")
    before = labelling.rows()
    assert labelling.merge().changes == 0
    assert labelling.rows() == before
    assert labelling.labels() == BOTH


def test_a_checkout_gives_the_folder_the_merged_labels(labelling: LabellingDesk) -> None:
    labelling.label(OURS)
    labelling.label(THEIRS, "trial")
    labelling.merge()
    labelling.write(datasets.check_out, "lab", "gaits", CheckoutRequest())
    (found,) = labelling.read(items.list_items, "lab", Kind.ANNOTATION, items.ItemFilters(collection="gaits")).items
    part = labelling.read(items.read_part, "lab", Kind.ANNOTATION, found.id, "annotation", revision=None)
    assert part.tree == labelling.document(BOTH)
    assert labelling.problems() == []


def test_a_commit_of_labels_is_repeated_and_undone_while_other_labels_stay(labelling: LabellingDesk) -> None:
    labelling.label(OURS)
    labelling.label(THEIRS, "trial")
    labelling.pick(version="trial")
    assert labelling.labels() == BOTH
    labelling.pick(version="main~1", undo=True)
    assert labelling.labels() == THEIRS
    assert labelling.problems() == []


def test_labels_of_the_same_frames_are_in_conflict_until_a_side_is_chosen(labelling: LabellingDesk) -> None:
    labelling.label(OURS)
    labelling.label(OTHERWISE, "trial")
    with pytest.raises(ConflictProblem) as refused:
        labelling.merge()
    (conflict,) = MergeAnswer.model_validate(refused.value.context).conflicts
    assert conflict.parts == ("annotation",)
    assert "the first in 'left' at 0:30" in conflict.reason
    assert conflict.segments is not None
    shown = [
        [(one.label, one.start, one.end) for one in side]
        for side in (conflict.segments.base, conflict.segments.ours, conflict.segments.theirs)
    ]
    assert shown == [[("step", 0, 30)], [("left", 0, 30)], [("right", 0, 30)]]
    labelling.merge(resolutions=(Resolution(path="labels", kind=Kind.ANNOTATION, take=Side.THEIRS),))
    assert labelling.labels() == OTHERWISE
    assert labelling.problems() == []


def test_a_conflict_lists_a_limited_number_of_segments(labelling: LabellingDesk) -> None:
    for label, branch in (("a", "main"), ("b", "trial")):
        labelling.label([(label, place, place + 1) for place in range(MOST_CONFLICTING_SEGMENTS + 1)], branch)
    (conflict,) = labelling.merge(preview=True).conflicts
    assert conflict.segments is not None
    assert len(conflict.segments.ours) == len(conflict.segments.theirs) == MOST_CONFLICTING_SEGMENTS


def test_labels_follow_a_clip_whose_motion_is_unchanged(labelling: LabellingDesk) -> None:
    """Somebody changes the description of the clip and moves the annotation to the new revision."""
    labelling.label(THEIRS, "trial")
    labelling.clip = labelling.publish_clip(comment="a walk")
    labelling.label(OURS)
    labelling.merge()
    assert labelling.annotation() == labelling.document(BOTH)


def test_labels_of_different_motions_are_not_merged(labelling: LabellingDesk) -> None:
    labelling.label(THEIRS, "trial")
    labelling.clip = labelling.publish_clip(seed=1)
    labelling.label(OURS)
    (conflict,) = labelling.merge(preview=True).conflicts
    assert (conflict.segments, "different motion" in conflict.reason) == (None, True)


def test_annotations_that_both_sides_have_added_are_in_conflict(labelling: LabellingDesk) -> None:
    labelling.label(OURS, path="others")
    labelling.label(THEIRS, "trial", path="others")
    (conflict,) = labelling.merge(preview=True).conflicts
    assert (conflict.parts, "have added" in conflict.reason) == (("annotation",), True)


@pytest.mark.parametrize(("limit", "most"), [("MOST_MERGED", 0), ("MOST_BYTES", 100)])
def test_annotations_beyond_a_limit_are_in_conflict(
    labelling: LabellingDesk, monkeypatch: pytest.MonkeyPatch, limit: str, most: int
) -> None:
    labelling.label(OURS)
    labelling.label(THEIRS, "trial")
    monkeypatch.setattr(f"marey_server.store.datasets.annotations.{limit}", most)
    (conflict,) = labelling.merge(preview=True).conflicts
    assert "merged segment by segment" in conflict.reason


def test_a_job_and_a_person_label_different_ranges(labelling: LabellingDesk) -> None:
    made = labelling.submit("label")
    labelling.label(OURS)
    stage_labels(labelling, THEIRS)
    assert labelling.job(made).publish_conflict is None
    assert labelling.labels() == BOTH
    assert labelling.commit().job == made
    assert labelling.problems() == []


def test_the_commit_of_a_job_merges_fewer_annotations_since_others_wait(
    labelling: LabellingDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("marey_server.store.datasets.output_plans.MOST_MERGED_BY_JOB", 0)
    made = labelling.submit("label")
    labelling.label(OURS)
    stage_labels(labelling, THEIRS)
    conflict = labelling.job(made).publish_conflict
    assert conflict is not None
    assert (conflict.branch, labelling.labels(), labelling.labels(made)) == (made, OURS, THEIRS)


def leave_no_room(tx: Transaction) -> None:
    """Set the limit of items of each project to the number of items that the project has."""
    for row in tx.execute(select(holding).join(project, project.c.id == holding.c.owner_id)).all():
        tx.execute(update(holding).where(holding.c.owner_id == row.owner_id).values(limits={"items": row.items}))


def test_a_merge_needs_no_room_for_items(labelling: LabellingDesk) -> None:
    """The new item with the merged labels is in no folder, so it does not count towards the limit of items."""
    labelling.label(OURS)
    labelling.label(THEIRS, "trial")
    labelling.write(leave_no_room)
    labelling.merge()
    assert labelling.labels() == BOTH
    assert labelling.problems() == []


def test_a_job_that_labels_the_frames_of_a_person_commits_to_a_branch_of_its_own(labelling: LabellingDesk) -> None:
    made = labelling.submit("label")
    labelling.label(OURS)
    stage_labels(labelling, OTHERWISE)
    conflict = labelling.job(made).publish_conflict
    assert conflict is not None
    assert (conflict.code, conflict.branch, conflict.paths) == ("paths-changed", made, ("labels",))
    assert (labelling.labels(), labelling.labels(made)) == (OURS, OTHERWISE)
    assert labelling.problems() == []


def stage_labels(labelling: LabellingDesk, segments: list[Segment]) -> None:
    """Complete a job with an annotation as its output."""
    lease = labelling.desk.claim()
    parts = {"annotation": labelling.document(segments)}
    output = StagedOutput(name="labels", kind=Kind.ANNOTATION, item_name="labels", parts=parts)
    labelling.desk.stage_outputs(lease, output)
    labelling.desk.complete(lease)

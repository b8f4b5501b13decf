"""Roles in folders: rights to set them, their end, and rights of jobs, checkouts and received versions to write."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from sqlalchemy import func, select
from tests.support.kept_rows import made_once
from tests.support.queue_desk import Desk, opened_desk
from tests.support.store_fixtures import Lab, declared, requiring, skeleton_tree

from marey_schemas.access import EVERY_MEMBER, FolderRoleChange, MemberChange, ProjectCreate, Role, UserCreate
from marey_schemas.datasets.checkouts import CheckoutRequest
from marey_schemas.datasets.commits import CommitCreate
from marey_schemas.datasets.naming import DatasetCreate
from marey_schemas.items import Collection, CollectionCreate, ItemChange, ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.purges import PurgeRequest
from marey_schemas.queue.commits import OutputsCommit
from marey_schemas.queue.job_kinds import find_kind
from marey_schemas.queue.jobs import ItemInput, JobCreate
from marey_schemas.queue.pipelines import PipelineCreate, PipelineStep
from marey_server.access.principal import SYSTEM, Principal
from marey_server.access.roles import RequiredRole
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
    PreconditionFailedProblem,
    UnauthenticatedProblem,
)
from marey_server.store import collections, datasets, items, members, projects, purging, users
from marey_server.store.database.connections import Database
from marey_server.store.database.prepared import Prepared
from marey_server.store.folder_roles import managing, rights
from marey_server.store.items import Draft, ItemFilters
from marey_server.store.jobs import reading, retrying, submission
from marey_server.store.jobs.result_places import result_folders
from marey_server.store.tables import collection, folder_role
from marey_server.store.transaction import Transaction

CREATE_ITEM = declared("POST", "/projects/{project}/{kind}")
SUBMIT = declared("POST", "/projects/{project}/jobs")
CANCEL, RETRY = (declared("POST", f"/jobs/{{job}}/{what}") for what in ("cancel", "retry"))
OWNER = declared("PUT", "/projects/{project}/collections/{collection}/roles/{user}")
MEMBER = declared("GET", "/projects/{project}/folder-roles")


def name_of(who: Principal) -> str:
    return str(who.user_name)


def change(role: str) -> FolderRoleChange:
    return FolderRoleChange.model_validate({"role": role})


def make_folder(lab: Lab, path: str) -> Collection:
    made: Collection = lab.write(collections.create_collection, "lab", CollectionCreate(path=path))
    return made


def folder_at(lab: Lab, path: str) -> Collection:
    """Return the folder with this path that is not deleted."""
    page = lab.read(collections.list_collections, "lab", path=path)
    (found,) = [one for one in page.items if one.path == path]
    assert isinstance(found, Collection)
    return found


def put(lab: Lab, folder: Collection, user: str, role: str, **kwargs: Any) -> Any:
    return lab.write(managing.put_folder_role, "lab", folder.id, user, change(role), required=OWNER, **kwargs)


def create(lab: Lab, who: Principal, path: str, name: str) -> Any:
    request = ItemCreate(name=name, collection=path, parts={"hierarchy": skeleton_tree()})
    return lab.write(items.create_item, "lab", Kind.SKELETON, request, who=who, required=CREATE_ITEM)


# -- setting roles ----------------------------------------------------------------------------------------------------


def test_the_role_of_a_member_counts_more_than_that_of_all_members(lab: Lab) -> None:
    folder = make_folder(lab, "delivered")
    put(lab, folder, EVERY_MEMBER, "reader")
    with pytest.raises(ForbiddenProblem) as refused:
        create(lab, lab.contributor, "delivered", "first")
    assert refused.value.error_code == "insufficient-role"
    assert "'delivered'" in refused.value.detail
    assert "your role there is reader" in refused.value.detail
    put(lab, folder, name_of(lab.contributor), "contributor")
    create(lab, lab.contributor, "delivered/monday", "first")
    for who in (lab.maintainer, lab.reader):
        with pytest.raises(ForbiddenProblem):
            create(lab, who, "delivered/monday", "second")
    create(lab, lab.owner, "delivered", "second")


def test_only_owners_set_roles_and_only_members_have_them(lab: Lab) -> None:
    folder = make_folder(lab, "a")
    for who in (lab.maintainer, lab.contributor):
        with pytest.raises(ForbiddenProblem):
            put(lab, folder, name_of(lab.reader), "contributor", who=who)
    with pytest.raises(NotFoundProblem) as stranger:
        put(lab, folder, name_of(lab.stranger), "contributor")
    assert stranger.value.error_code == "no-member"
    with pytest.raises(ConflictProblem) as owner:
        put(lab, folder, name_of(lab.owner), "reader")
    assert owner.value.error_code == "is-owner"
    create(lab, lab.owner, "", "top")
    top = lab.read(lambda tx: tx.execute(select(collection.c.id).where(collection.c.path == "")).scalar_one())
    with pytest.raises(InvalidProblem) as root:
        lab.write(managing.put_folder_role, "lab", top, EVERY_MEMBER, change("reader"), required=OWNER)
    assert root.value.error_code == "is-root"
    with pytest.raises(ValueError, match="role"):
        change("owner")


def test_a_role_is_changed_at_an_expected_rev_listed_and_removed(lab: Lab) -> None:
    near, far = make_folder(lab, "a"), make_folder(lab, "a/b")
    reader = name_of(lab.reader)
    first = put(lab, near, reader, "contributor", absent=True)
    put(lab, far, EVERY_MEMBER, "reader")
    with pytest.raises(PreconditionFailedProblem):
        put(lab, near, reader, "maintainer", absent=True)
    second = put(lab, near, reader, "maintainer", expected_rev=first.rev)
    assert (second.role, second.rev) == (Role.MAINTAINER, first.rev + 1)
    with pytest.raises(PreconditionFailedProblem):
        put(lab, near, reader, "reader", expected_rev=first.rev)
    with pytest.raises(NotFoundProblem):
        put(lab, far, reader, "reader", expected_rev=1)

    def listed(**kwargs: Any) -> list[tuple[str, str, str]]:
        page = lab.read(managing.list_folder_roles, "lab", who=lab.reader, required=MEMBER, **kwargs)
        return [(one.folder, one.user, one.role) for one in page.items]

    assert listed() == [("a", reader, "maintainer"), ("a/b", "*", "reader")]
    assert listed(folder="a/b") == listed(user_name="*") == [("a/b", "*", "reader")]
    assert listed(user_name=reader) == [("a", reader, "maintainer")]
    remove = (managing.remove_folder_role, "lab", near.id, reader)
    with pytest.raises(PreconditionFailedProblem):
        lab.write(*remove, required=OWNER, expected_rev=first.rev)
    lab.write(*remove, required=OWNER, expected_rev=second.rev)
    with pytest.raises(NotFoundProblem):
        lab.write(*remove, required=OWNER, expected_rev=None)
    kinds = [(one.kind, one.body) for one in lab.events() if one.kind.startswith("folder_role")]
    assert kinds == [
        ("folder_role.added", {"path": "a", "user": reader, "role": "contributor"}),
        ("folder_role.added", {"path": "a/b", "user": "*", "role": "reader"}),
        ("folder_role.changed", {"path": "a", "user": reader, "role": "maintainer", "was": "contributor"}),
        ("folder_role.removed", {"path": "a", "user": reader, "was": "maintainer"}),
    ]


def test_roles_end_with_the_membership_and_with_the_purge_of_the_folder(lab: Lab) -> None:
    folder = make_folder(lab, "a")
    reader = name_of(lab.reader)
    put(lab, folder, reader, "contributor")
    put(lab, folder, EVERY_MEMBER, "maintainer")
    lab.write(members.remove_member, "lab", reader, expected_rev=None, required=OWNER)
    lab.write(members.put_member, "lab", reader, MemberChange(role=Role.READER), required=OWNER)
    page = lab.read(managing.list_folder_roles, "lab", required=MEMBER)
    assert [one.user for one in page.items] == [EVERY_MEMBER]
    made = create(lab, lab.owner, "a", "rig")
    maintain = declared("DELETE", "/projects/{project}/collections/{collection}")
    lab.write(collections.delete_collection, "lab", folder.id, expected_rev=None, required=maintain)
    assert lab.read(managing.list_folder_roles, "lab", required=MEMBER).items == ()
    request = PurgeRequest(item=made.id)
    purge = declared("POST", "/projects/{project}/purges")
    prepared = lab.read(purging.prepare_purge, "lab", request, required=purge)
    lab.write(purging.record_purge, "lab", request, prepared, required=purge)
    assert lab.read(lambda tx: tx.execute(select(func.count()).select_from(folder_role)).scalar_one()) == 0


def test_roles_end_when_a_member_becomes_an_owner(lab: Lab) -> None:
    """An owner's roles in folders would have no effect, but apply again, unnoticed, if the owner is made a member."""
    folder = make_folder(lab, "a")
    reader = name_of(lab.reader)
    for user in (reader, EVERY_MEMBER):
        put(lab, folder, user, "contributor")
    for role, left in ((Role.MAINTAINER, [EVERY_MEMBER, reader]), (Role.OWNER, [EVERY_MEMBER])):
        lab.write(members.put_member, "lab", reader, MemberChange(role=role), required=OWNER)
        page = lab.read(managing.list_folder_roles, "lab", required=MEMBER)
        assert [one.user for one in page.items] == left


def test_the_number_of_roles_is_limited(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(managing, "MOST_FOLDER_ROLES", 2)
    folders = [make_folder(lab, path) for path in "abc"]
    for folder in folders[:2]:
        put(lab, folder, EVERY_MEMBER, "reader")
    with pytest.raises(ConflictProblem) as refused:
        put(lab, folders[2], EVERY_MEMBER, "reader")
    assert refused.value.error_code == "too-many-folder-roles"
    put(lab, folders[1], EVERY_MEMBER, "contributor")


def test_roles_in_deleted_folders_have_a_limit_of_their_own(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """A restoration may exceed the limit for existing folders."""
    delete = declared("DELETE", "/projects/{project}/collections/{collection}")
    monkeypatch.setattr(managing, "MOST_FOLDER_ROLES", 1)
    monkeypatch.setattr(managing, "MOST_WITH_DELETED", 2)
    folders = [make_folder(lab, path) for path in "abc"]
    for folder in folders[:2]:
        put(lab, folder, EVERY_MEMBER, "reader")
        lab.write(collections.delete_collection, "lab", folder.id, expected_rev=None, required=delete)
    with pytest.raises(ConflictProblem) as refused:
        put(lab, folders[2], EVERY_MEMBER, "reader")
    assert refused.value.error_code == "too-many-folder-roles"
    for folder in folders[:2]:
        lab.write(collections.restore_collection, "lab", folder.id, required=delete)
    assert len(lab.read(managing.list_folder_roles, "lab", required=MEMBER).items) == 2
    for folder in folders[:2]:
        remove = (managing.remove_folder_role, "lab", folder.id, EVERY_MEMBER)
        lab.write(*remove, expected_rev=None, required=OWNER)
    put(lab, folders[2], EVERY_MEMBER, "reader")


def test_a_guest_has_no_role_in_folders_and_cannot_see_those_of_others(lab: Lab) -> None:
    put(lab, make_folder(lab, "a"), EVERY_MEMBER, "contributor")
    lab.make_public()
    for who in (lab.stranger, lab.anonymous):
        (shown,) = lab.read(collections.list_collections, "lab", who=who).items
        assert shown.role is None
        with pytest.raises((ForbiddenProblem, UnauthenticatedProblem)):
            lab.read(managing.list_folder_roles, "lab", who=who, required=MEMBER)
        with pytest.raises((ForbiddenProblem, UnauthenticatedProblem)):
            create(lab, who, "a", "rig")


def test_a_role_in_a_folder_gives_nothing_in_another_project(lab: Lab) -> None:
    put(lab, make_folder(lab, "a"), name_of(lab.reader), "maintainer")
    lab.database.write(lab.owner, projects.create_project, ProjectCreate(name="other"))
    lab.database.write(
        lab.owner, requiring(OWNER, members.put_member), "other", name_of(lab.reader), MemberChange(role=Role.READER)
    )
    request = ItemCreate(name="rig", collection="a", parts={"hierarchy": skeleton_tree()})
    with pytest.raises(ForbiddenProblem):
        lab.database.write(lab.reader, requiring(CREATE_ITEM, items.create_item), "other", Kind.SKELETON, request)


def test_one_query_reads_the_roles_for_many_items(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    put(lab, make_folder(lab, "a"), EVERY_MEMBER, "reader")
    asked: list[object] = []
    run = Transaction.run

    def note(self: Transaction, statement: Prepared, parameters: Mapping[str, Any]) -> list[Any]:
        if statement is rights._OVERRIDES:
            asked.append(parameters)
        return run(self, statement, parameters)

    def publish(tx: Transaction) -> None:
        row = projects.require(tx, "lab")
        for start in (0, 10):
            drafts = [
                Draft(f"d{n}", Kind.SKELETON, f"d{n}", {"hierarchy": skeleton_tree(bone_m=n + 1)}, f"b/{n}")
                for n in range(start, start + 10)
            ]
            given = rights.rights_of_caller(tx, row)
            items.publish(tx, row, drafts, author_id=tx.principal.user_id, rights=given)

    monkeypatch.setattr(Transaction, "run", note)
    lab.write(publish, who=lab.contributor)
    lab.write(publish, who=lab.owner)
    assert len(asked) == 1


# -- restoring items --------------------------------------------------------------------------------------------------


def test_an_item_is_restored_only_with_the_role_at_its_future_place(lab: Lab) -> None:
    """The role in a deleted folder does not count for the new folder with the same path."""
    delete = declared("DELETE", "/projects/{project}/collections/{collection}")
    restore = declared("POST", "/projects/{project}/{kind}/{item}/restore")
    rig = create(lab, lab.owner, "a/b", "rig")
    put(lab, folder_at(lab, "a/b"), name_of(lab.maintainer), "maintainer")
    put(lab, folder_at(lab, "a"), EVERY_MEMBER, "contributor")
    lab.write(collections.delete_collection, "lab", folder_at(lab, "a/b").id, expected_rev=None, required=delete)
    with pytest.raises(ForbiddenProblem) as refused:
        lab.write(items.restore_item, "lab", Kind.SKELETON, rig.id, who=lab.maintainer, required=restore)
    assert refused.value.context == {"folder": "a/b", "role": "contributor"}
    put(lab, folder_at(lab, "a"), EVERY_MEMBER, "maintainer")
    back = lab.write(items.restore_item, "lab", Kind.SKELETON, rig.id, who=lab.maintainer, required=restore)
    assert back.collection == "a/b"


@pytest.mark.parametrize("role_below", [None, "maintainer"])
def test_a_folder_is_not_restored_out_of_a_folder_that_was_deleted_later(lab: Lab, role_below: str | None) -> None:
    delete = declared("DELETE", "/projects/{project}/collections/{collection}")
    restore = declared("POST", "/projects/{project}/collections/{collection}/restore")
    inner, outer = make_folder(lab, "a/b/x"), folder_at(lab, "a")
    put(lab, outer, EVERY_MEMBER, "reader")
    if role_below is not None:
        put(lab, inner, EVERY_MEMBER, role_below)
    for folder in (inner, folder_at(lab, "a/b"), outer):
        lab.write(collections.delete_collection, "lab", folder.id, expected_rev=None, required=delete)
    put(lab, make_folder(lab, "a/b"), EVERY_MEMBER, "maintainer")  # new folders at the old paths
    gone = lab.read(collections.list_collections, "lab", who=lab.maintainer, deleted=True).items
    assert [one.role for one in gone if one.id == inner.id] == [role_below or "reader"]
    with pytest.raises(ForbiddenProblem) as refused:
        lab.write(collections.restore_collection, "lab", inner.id, who=lab.maintainer, required=restore)
    assert refused.value.context["role"] == "reader"
    lab.write(collections.restore_collection, "lab", inner.id, required=restore)


# -- jobs -------------------------------------------------------------------------------------------------------------


class Studio:
    """Project whose owner is the user of the desk, with the reader `rob`, who submits jobs."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        made = desk.database.write(SYSTEM, users.create_user, UserCreate(name="rob"))
        self.rob = Principal("user", made.id, "rob", scopes=("read", "write", "jobs"))
        self.write(OWNER, members.put_member, "rob", MemberChange(role=Role.READER))
        self.team = self.write(CREATE_ITEM, collections.create_collection, CollectionCreate(path="team"))

    def write(self, required: RequiredRole, function: Any, *args: Any, who: Principal | None = None, **kw: Any) -> Any:
        """Run a function that writes, as the owner or as `who`, as an operation that requires a role."""
        return self.desk.database.write(who or self.desk.user, requiring(required, function), "lab", *args, **kw)

    def put(self, role: str, user: str = "rob") -> None:
        """Set the role of a member in the folder `team`."""
        self.write(OWNER, managing.put_folder_role, self.team.id, user, change(role))

    def submit(self, who: Principal, kind: str = "sum", **fields: Any) -> str:
        """Submit a job, and return its id."""
        (made,) = self.write(SUBMIT, submission.submit, (JobCreate(kind=kind, **fields),), who=who)
        return str(made.id)

    def work(self, *names: str, **fields: Any) -> None:
        """Claim a job, and complete it with results of these names."""
        lease = self.desk.claim()
        self.desk.stage(lease, *names, **fields)
        self.desk.complete(lease)


def opened_studio(database: Database) -> Studio:
    return Studio(opened_desk(database))


@pytest.fixture
def studio(database: Database, test_kinds: None) -> Studio:
    return made_once(opened_studio, database)


def test_a_reader_runs_jobs_that_write_to_the_readers_folder(studio: Studio) -> None:
    with pytest.raises(ForbiddenProblem):
        studio.submit(studio.rob, into="team")
    studio.put("contributor")
    for into in ("", "other", "teams"):
        with pytest.raises(ForbiddenProblem) as refused:
            studio.submit(studio.rob, into=into)
        assert refused.value.context["role"] == "reader"
    made = studio.submit(studio.rob, into="team/made")
    studio.work("a", collection="below")
    assert studio.desk.state(made) == "succeeded"
    assert [one.name for one in studio.desk.outputs(made)] == ["a"]
    own = studio.submit(studio.rob, "errand", into="team")
    studio.desk.database.write(studio.rob, requiring(CANCEL, reading.cancel_job), own)
    assert studio.desk.state(own) == "cancelled"
    theirs = studio.submit(studio.desk.user, "errand")
    with pytest.raises(ForbiddenProblem):
        studio.desk.database.write(studio.rob, requiring(CANCEL, reading.cancel_job), theirs)
    again = studio.desk.database.write(studio.rob, requiring(RETRY, retrying.retry_job), own)
    assert again.retry_of == own
    studio.put("reader")
    with pytest.raises(ForbiddenProblem):
        studio.desk.database.write(studio.rob, requiring(RETRY, retrying.retry_job), again.id)


@pytest.mark.parametrize("operation", ["submit", "pipeline", "retry"])
def test_rights_are_read_before_items_are_read_and_jobs_are_locked(
    studio: Studio, monkeypatch: pytest.MonkeyPatch, operation: str
) -> None:
    """In another order, a submission could miss the move of a folder, or hold locks of jobs while it waits."""
    studio.put("contributor")
    first = studio.submit(studio.rob, "errand", into="team")
    last = studio.submit(studio.rob, "errand", into="team", after=(first,))
    studio.desk.database.write(studio.rob, requiring(CANCEL, reading.cancel_job), last)
    steps = {"one": PipelineStep(kind="errand"), "two": PipelineStep(kind="errand", after=("one",))}
    pipeline = PipelineCreate(into="team", steps=steps)
    acts: dict[str, tuple[Any, ...]] = {
        "submit": (SUBMIT, submission.submit, "lab", (JobCreate(kind="errand", into="team", after=(first,)),)),
        "pipeline": (SUBMIT, submission.submit_pipeline, "lab", pipeline),
        "retry": (RETRY, retrying.retry_job, last),
    }
    seen: list[str] = []

    def noted(name: str, function: Any) -> Any:
        def run(*args: Any) -> Any:
            seen.append(name)
            return function(*args)

        return run

    for module in (submission, retrying):
        for name in ("find_items", "lock_jobs", "rights_of_caller"):
            if hasattr(module, name):
                monkeypatch.setattr(module, name, noted(name, getattr(module, name)))
    required, function, *args = acts[operation]
    studio.desk.database.write(studio.rob, requiring(required, function), *args)
    assert "lock_jobs" in seen
    assert seen[0] == "rights_of_caller"


def test_results_follow_the_inputs_into_their_folders(studio: Studio) -> None:
    studio.write(OWNER, members.put_member, "rob", MemberChange(role=Role.CONTRIBUTOR))
    studio.put("reader")
    clips = studio.desk.things(1, "team")
    fields = {"inputs": {"things": [ItemInput(item=clips[0])]}}
    studio.submit(studio.rob, "square", **fields)
    studio.submit(studio.rob, "square", **fields, into="elsewhere")
    with pytest.raises(ForbiddenProblem):
        studio.submit(studio.rob, "square", **fields, into="team/made")


@pytest.mark.parametrize(
    ("kind", "params", "named", "into", "folders"),
    [
        ("tree", {}, {"model": "team"}, "", ["team"]),
        ("tree", {}, {"model": "team/below"}, "", ["team/below"]),
        ("tree", {}, {"model": None}, "", []),
        ("edit", {"in_place": True}, {"clips": "team"}, "", ["team"]),
        ("edit", {"in_place": True}, {"clips": None}, "", []),
        ("edit", {"suffix": "x"}, {"clips": None}, "", []),
        ("edit", {}, {"clips": None}, "made", ["made"]),
        ("edit", {}, {"clips": "team"}, "made", ["made/team"]),
        ("edit", {}, {"clips": "team/below"}, "made", ["made/below"]),
        ("model", {}, {"aligned": "team"}, "", [""]),
    ],
)
def test_the_folders_of_results_are_those_that_are_known_before_the_job(
    kind: str, params: dict[str, Any], named: dict[str, str | None], into: str, folders: list[str]
) -> None:
    """The folder of an input is None if the input is a future result of another job.

    Inputs in `team/below` are known results of a job that wrote to the subfolder `below`.
    """

    def pin(folder: str | None) -> dict[str, Any]:
        if folder is None:
            return {"job": "job_1"}
        return {"collection": folder, "name": "n"} | ({"below": "below"} if folder == "team/below" else {})

    pins = {name: [pin(folder)] for name, folder in named.items()}
    assert result_folders(find_kind(kind), params, pins, into) == folders


def test_a_job_fails_if_its_author_loses_the_role_before_its_end(studio: Studio) -> None:
    studio.put("contributor")
    made = studio.submit(studio.rob, into="team")
    lease = studio.desk.claim()
    studio.desk.stage(lease, "a")
    studio.put("reader")
    studio.put("contributor", EVERY_MEMBER)  # so that the author may still run jobs somewhere
    studio.desk.complete(lease)
    job = studio.desk.job(made)
    assert job.failure is not None
    assert (job.state, job.failure.code) == ("failed", "author-lost-access")
    assert "'team'" in job.failure.detail
    assert studio.desk.outputs(made) == []


def test_a_job_fails_if_it_writes_elsewhere_than_its_submission_told(studio: Studio) -> None:
    studio.write(OWNER, members.put_member, "rob", MemberChange(role=Role.CONTRIBUTOR))
    studio.put("reader")
    made, other = studio.submit(studio.rob), studio.submit(studio.rob, params={"number": 1})
    studio.work("a", collection="team/below")
    studio.work("a", collection="teams")
    assert (studio.desk.state(made), studio.desk.state(other)) == ("failed", "succeeded")


def test_a_cached_result_is_not_published_where_the_author_may_not_write(studio: Studio) -> None:
    studio.write(OWNER, members.put_member, "rob", MemberChange(role=Role.CONTRIBUTOR))
    studio.put("reader")
    studio.submit(studio.desk.user)
    studio.work("a", collection="team")
    made = studio.submit(studio.rob)
    assert studio.desk.job(made).failure is not None
    assert studio.desk.state(made) == "failed"


def test_a_reader_with_a_folder_commits_nothing(studio: Studio) -> None:
    studio.put("maintainer")
    studio.write(CREATE_ITEM, datasets.create_dataset, DatasetCreate(name="gaits", collection="team"))
    with pytest.raises(ForbiddenProblem):
        studio.submit(studio.rob, into="team", commit=OutputsCommit.at("gaits"))
    commit = declared("POST", "/projects/{project}/datasets/{dataset}/commits")
    with pytest.raises(ForbiddenProblem):
        studio.write(commit, datasets.prepare_commit, "gaits", CommitCreate(message="m"), who=studio.rob)


# -- versions ---------------------------------------------------------------------------------------------------------


def test_a_checkout_needs_the_role_in_all_folders_of_the_dataset(lab: Lab) -> None:
    checkout = declared("POST", "/projects/{project}/datasets/{dataset}/checkout")
    create(lab, lab.owner, "data/done", "rig")
    lab.write(datasets.create_dataset, "lab", DatasetCreate(name="d", collection="data"))
    prepared = lab.read(datasets.prepare_commit, "lab", "d", CommitCreate(message="m"), required=CREATE_ITEM)
    lab.write(datasets.record_commit, "lab", "d", prepared)
    request = CheckoutRequest(version="main", discard=True)
    lab.write(datasets.check_out, "lab", "d", request, who=lab.maintainer, required=checkout)
    (done,) = lab.read(collections.list_collections, "lab", path="data/done").items
    put(lab, done, EVERY_MEMBER, "contributor")
    with pytest.raises(ForbiddenProblem):
        lab.write(datasets.check_out, "lab", "d", request, who=lab.maintainer, required=checkout)
    put(lab, done, EVERY_MEMBER, "reader")
    with pytest.raises(ForbiddenProblem):
        lab.write(datasets.create_dataset, "lab", DatasetCreate(name="e", collection="data/done"), who=lab.maintainer)


def test_a_checkout_creates_an_item_that_the_caller_may_not_restore_elsewhere(lab: Lab) -> None:
    checkout = declared("POST", "/projects/{project}/datasets/{dataset}/checkout")
    maintain = declared("DELETE", "/projects/{project}/{kind}/{item}")
    rig = create(lab, lab.owner, "data", "rig")
    lab.write(datasets.create_dataset, "lab", DatasetCreate(name="d", collection="data"))
    prepared = lab.read(datasets.prepare_commit, "lab", "d", CommitCreate(message="m"), required=CREATE_ITEM)
    lab.write(datasets.record_commit, "lab", "d", prepared)
    which = ("lab", Kind.SKELETON, rig.id)
    lab.write(items.change_item, *which, ItemChange(collection="elsewhere"), expected_rev=None, required=maintain)
    lab.write(items.delete_item, *which, expected_rev=None, required=maintain)
    put(lab, folder_at(lab, "elsewhere"), EVERY_MEMBER, "contributor")
    request = CheckoutRequest(version="main", discard=True)
    answer = lab.write(datasets.check_out, "lab", "d", request, who=lab.maintainer, required=checkout)
    assert answer.added == 1
    (made,) = lab.read(items.list_items, "lab", Kind.SKELETON, ItemFilters()).items
    assert (made.collection, made.name) == ("data", "rig")
    assert made.id != rig.id

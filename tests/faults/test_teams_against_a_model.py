"""Several users of two servers, compared with a model. Answers are lost, and servers die between any two steps."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis.errors import Flaky
from sqlalchemy import update
from tests.support.database_fixtures import copied_sqlite
from tests.support.teams.hosts import local_hosts, mortal_hosts
from tests.support.teams.machine import Diverged, run_programs
from tests.support.teams.model import PARTNER, STUDIO
from tests.support.teams.mortal_servers import COUNTER, Countdown
from tests.support.teams.world import World
from tests.support.tiers import examples, is_soak, steps

from marey_server.access import roles
from marey_server.access.folder_rights import FolderRights
from marey_server.store import garbage
from marey_server.store.database.connections import Database
from marey_server.store.datasets import committing, merging
from marey_server.store.purging.versions import VersionSearch
from marey_server.store.tables import dataset_ref
from marey_server.store.transaction import Transaction
from marey_versions.merging import MergedEntries, merge_entries

pytestmark = pytest.mark.timeout(3600)

Databases = dict[str, tuple[str, Database]]


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the archives of running copies in a folder of the test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def databases(database_url: str, sqlite_template: Path, tmp_path: Path) -> Iterator[Databases]:
    """The databases of two servers, with addresses; the second server always uses SQLite."""
    folder = tmp_path / "partner-database"
    folder.mkdir()
    urls = {STUDIO: database_url, PARTNER: copied_sqlite(sqlite_template, folder)}
    opened = {name: (url, Database(url)) for name, url in urls.items()}
    yield opened
    for _, database in opened.values():
        database.close()


EXPECTED = (
    "(deaths", "(lost answers)", "(repeated writes)", "ArchiveAndImport", "CheckOut", "CherryPick", "CollectGarbage",
    "CommitChanges", "CommitFolder", "Copy", "CreateAnnotation", "CreateBranch", "CreateClip", "CreateTag",
    "DeleteItem", "DeleteRef", "Merge", "merge-conflicts", "Resolved", "Purge", "still-held", "Rename", "Reset",
    "RestoreItem", "Revert", "Revise", "SetFolderRole reader", "SetRole reader", "UploadFile",
    "insufficient-role", "overtaken",
)  # fmt: skip
"""Texts, each of which must occur in a name that a long run counts; otherwise the run would test too little."""


@pytest.mark.every_nth(2)
def test_nothing_that_several_users_do_on_two_servers_diverges_from_the_model(
    databases: Databases, tmp_path: Path
) -> None:
    with mortal_hosts(databases, tmp_path) as hosts:
        world = World(hosts)
        try:
            run_programs(world, examples(1, soak=10), steps(40))
        finally:
            world.close()
            print(dict(sorted(world.counts.items())))
    assert world.counts["CommitChanges"] > 0
    if is_soak():
        assert not [text for text in EXPECTED if not any(text in label for label in world.counts)]


# -- faults that the model finds --------------------------------------------------------------------------------------


def drop_their_side(patch: pytest.MonkeyPatch) -> None:
    """Let merges ignore all changes of the version that is merged (`theirs`)."""
    patch.setattr(merging, "merge_entries", lambda ours, _theirs, take, merge: merge_entries(ours, [], take, merge))


def move_whatever_the_head_is(patch: pytest.MonkeyPatch) -> None:
    """Let commits move a branch without a check that its newest commit is the expected one."""

    def move(tx: Transaction, prepared: Any, digest: str, _mover: Any) -> None:
        which = (dataset_ref.c.dataset_id == prepared.dataset_id, dataset_ref.c.name == prepared.branch)
        tx.execute(update(dataset_ref).where(*which).values(digest=digest))

    patch.setattr(committing, "move_branch_to", move)


def collect_without_grace(patch: pytest.MonkeyPatch) -> None:
    """Let garbage collection delete files that were uploaded a moment ago."""
    patch.setattr(garbage, "collect_garbage", partial(garbage.collect_garbage, grace_us=-1))


def purge_what_versions_contain(patch: pytest.MonkeyPatch) -> None:
    """Let purges ignore the versions that contain an item."""
    patch.setattr(VersionSearch, "holders", lambda _self, _tx, _contents: {})


def revert_only_one_entry(patch: pytest.MonkeyPatch) -> None:
    """Let merges, reverts and cherry-picks change only the first of the entries that they should change."""

    def merge(ours: Iterable[Any], theirs: Iterable[Any], *options: Any) -> MergedEntries:
        return merge_entries(ours, list(theirs)[:1], *options)

    patch.setattr(merging, "merge_entries", merge)


def forget_write_ids(patch: pytest.MonkeyPatch) -> None:
    """Let the server execute repeated writes again, instead of recognising their `write_id`."""
    patch.setattr(committing, "recorded_as", lambda _tx, _dataset, _write_id: None)


def check_no_role(patch: pytest.MonkeyPatch) -> None:
    """Let every member do everything."""
    patch.setattr(roles, "includes", lambda _held, _needed: True)


def ignore_folder_roles(patch: pytest.MonkeyPatch) -> None:
    """Let members have their roles in the project in every folder."""
    patch.setattr(FolderRights, "require", lambda _self, _path, _role: None)


VERSIONS = ("commit", "create_branch", "merge", "revise", "annotate")
PLANTS: dict[Callable[[pytest.MonkeyPatch], None], tuple[str, ...]] = {
    drop_their_side: VERSIONS,
    move_whatever_the_head_is: ("commit", "race"),
    collect_without_grace: ("upload_file", "collect_garbage"),
    purge_what_versions_contain: ("commit", "delete_item", "purge_item"),
    revert_only_one_entry: ("commit", "revert"),
    forget_write_ids: ("commit", "repeat"),
    check_no_role: ("commit", "demote"),
    ignore_folder_roles: ("create_clip", "restrict"),
}
"""Planted faults; for each fault, the kinds of steps that random programs need in order to find it."""


def test_a_step_that_began_before_a_death_is_cancelled_does_not_restore_the_countdown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counter = tmp_path / "counter"
    counter.write_bytes(COUNTER.pack(9))
    in_server, in_test = Countdown(counter), Countdown(counter)
    has_read, may_write = threading.Event(), threading.Event()

    class Slow(Countdown):
        @property
        def left(self) -> int:
            left = int(COUNTER.unpack(self._shared)[0])
            has_read.set()
            may_write.wait(30)
            return left

        @left.setter
        def left(self, steps: int) -> None:
            COUNTER.pack_into(self._shared, 0, steps)

    in_server.__class__ = Slow
    step, cancel = threading.Thread(target=in_server.step), threading.Thread(target=in_test.cancel)
    step.start()
    assert has_read.wait(30)
    cancel.start()
    cancel.join(0.2)
    may_write.set()
    step.join(30)
    cancel.join(30)
    assert in_test.left == 0


@pytest.mark.soak
@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.__name__)
@pytest.mark.every_database
def test_the_model_finds_a_planted_fault(
    databases: Databases, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plant: Callable[[pytest.MonkeyPatch], None]
) -> None:
    with local_hosts(databases, tmp_path) as hosts:
        world = World(hosts)
        plant(monkeypatch)
        with pytest.raises((Diverged, Flaky)):  # flaky: a race that is repeated may end in another way
            run_programs(world, 20, 60, PLANTS[plant])
        world.close()
    assert world.divergences

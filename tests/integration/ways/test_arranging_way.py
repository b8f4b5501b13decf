"""Organisation of a project by the command line: items are moved, renamed, tagged, removed and restored."""

import functools
import io
import itertools
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer
from tests.support.server_process import ServerProcess
from tests.support.store_fixtures import skeleton_tree

from marey_client.cli import main
from marey_client.errors import Conflict, Unreachable
from marey_client.handles.clips import ClipHandle
from marey_client.imports import find_files
from marey_client.items import Items
from marey_client.marey import Marey
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.access import ProjectCreate
from marey_schemas.items import ItemChange
from marey_schemas.options.imports import ImportOptions

Command = Callable[..., SimpleNamespace]

NAMES = (f"lab{number}" for number in itertools.count(1))


pytestmark = pytest.mark.parametrize("server", ["sqlite"], indirect=True, scope="session")


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three short walks."""
    folder = tmp_path_factory.mktemp("takes")
    for name, speed_m_s in (("a", 1.0), ("b", 1.2), ("c", 1.4)):
        (folder / f"{name}.bvh").write_bytes(write_bvh(generate_gait(speed_m_s, 0.0, 0.5)))
    return folder


def with_takes(marey: Marey, takes: Path) -> ProjectHandle:
    project = marey.create_project(ProjectCreate(name=next(NAMES)))
    project.imports.upload(find_files([takes]).files, ImportOptions(collection="raw"))
    return project


@pytest.fixture(scope="module")
def shared(marey: Marey, takes: Path) -> ProjectHandle:
    """The project of all tests that change nothing."""
    return with_takes(marey, takes)


@pytest.fixture
def lab(request: pytest.FixtureRequest, marey: Marey, takes: Path) -> ProjectHandle:
    """A project with three clips: `raw/a`, `raw/b` and `raw/c`. It is new, unless the test asks for `shared`."""
    if "shared" in request.fixturenames:
        kept: ProjectHandle = request.getfixturevalue("shared")
        return kept
    return with_takes(marey, takes)


@pytest.fixture
def run(
    server: ServerProcess,
    lab: ProjectHandle,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> Command:
    """Function that runs a command and returns its result.

    In the arguments and in the output, `lab` is the name of the project of the test.
    """
    monkeypatch.setenv("MAREY_URL", server.url)
    monkeypatch.setenv("MAREY_DATA", str(server.data))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))

    def command(*arguments: str, status: int = 0, terminal: str | None = None) -> SimpleNamespace:
        words = [re.sub(r"^lab\b", lab.name, word) for word in arguments]
        monkeypatch.setattr(sys, "argv", ["marey", *words])
        stdin = io.StringIO(terminal or "")
        monkeypatch.setattr(stdin, "isatty", lambda: terminal is not None)
        monkeypatch.setattr(sys, "stdin", stdin)
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = (text.replace(lab.name, "lab") for text in capsys.readouterr())
        assert (ended.value.code or 0) == status, out + err
        return SimpleNamespace(stdout=out, stderr=err)

    return command


def clips(lab: ProjectHandle) -> list[str]:
    return sorted(clip.path for clip in lab.clips.list())


def test_items_and_folders_are_renamed_and_moved_with_their_ids(run: Command, lab: ProjectHandle) -> None:
    ids = {clip.name: clip.id for clip in lab.clips.list()}
    assert "lab/raw/a is moved to lab/raw/walk" in run("mv", "lab/raw/a", "lab/raw/walk").stderr
    assert "lab/raw/walk is already there" in run("mv", "lab/raw/walk", "lab/raw/walk").stderr
    assert lab.clips.get(ids["a"]).path == "raw/walk"
    run("mv", "lab/raw/b", f"lab/{ids['c']}", "lab/takes/day-1/")  # made, as it is not there
    assert clips(lab) == ["raw/walk", "takes/day-1/b", "takes/day-1/c"]
    run("mv", "lab/takes", "lab/raw")  # a folder that is there: into it
    run("mv", "lab/raw/takes/day-1", "lab/raw/first")
    assert clips(lab) == ["raw/first/b", "raw/first/c", "raw/walk"]
    moved = json.loads(run("mv", "lab/raw/walk", "lab/", "--json").stdout)
    assert [(one["id"], one["name"], one["collection"]) for one in moved["moved"]] == [(ids["a"], "walk", "")]


@pytest.mark.usefixtures("shared")
@pytest.mark.parametrize(
    ("arguments", "status", "told"),
    [
        (["mv", "lab/raw/a", "lab/raw/b"], 1, "lab/raw/a: There is already a clip with this name in the collection;"),
        (["mv", "lab/raw/a", "studio/a"], 2, "lab/raw/a cannot be moved to another project"),
        (["mv", "lab/raw/nobody", "lab/raw/b"], 2, "there is no item or folder at lab/raw/nobody"),
        (["mv", "lab/raw/a"], 2, "give the items to move and the destination"),
        (["mv", "lab", "lab/b"], 2, "'lab' is a project"),
        (["mv", "lab/raw", "lab/raw/below/"], 1, "'raw' cannot be moved into itself"),
        (["mv", "lab/raw/a", "lab/nobody", "lab/other/"], 2, "there is no item or folder at lab/nobody"),
        (["rm", "lab/raw"], 2, "remove 3 items (lab/raw/)? This needs a confirmation"),
        (["rm", "lab/raw/a", "lab/raw", "--yes"], 2, "lab/raw/a is inside lab/raw, and the command names both"),
        (["rm", "lab/raw/a", "lab/raw/a", "--yes"], 2, "lab/raw/a is named twice"),
        (["rm", "lab/raw/a/", "--yes"], 2, "there is no folder at lab/raw/a;"),
        (["restore", "lab/raw/a"], 2, "no deleted item or folder at lab/raw/a; `marey ls --deleted lab` lists"),
        (["tag", "lab/raw/a"], 2, "give them with --add"),
        (["tag", "lab/raw", "--add", "x"], 2, "lab/raw is a folder, and folders have no tags"),
        (["rm", "lab/raw/a", "--kind", "stone"], 2, "'stone' is not a kind of item"),
        (["rm", "lab", "--query", "name = nobody", "--yes"], 2, "the query selects no item of the kind clip in lab;"),
        (["rm", "lab/raw/a", "--query", "name = a", "--yes"], 2, "there is no folder at lab/raw/a; --query selects"),
        (["rm", "lab", "--query", "name = a", "--kind", "collection", "--yes"], 2, "items, not folders"),
        (["rm", "lab", "--query", "name =", "--yes"], 1, "the query ends too early"),
        (["restore", "lab", "--query", "name = a"], 2, "the query selects no deleted item of the kind clip in lab;"),
        (["restore", "lab/nowhere", "--query", "name = a"], 2, "there is no folder at lab/nowhere"),
        (["restore", "lab/raw/a", "--preview"], 2, "--preview lists the items that a query selects; add --query"),
        (["ls", "--deleted", "lab", "--stale"], 2, "--deleted cannot be combined with --explain or --stale"),
        (["ls", "lab", "--explain", "--query", "name = a", "--tag", "x"], 2, "leave out --tag, --find and --stale"),
    ],
)
def test_what_cannot_be_is_told_and_changes_nothing(
    run: Command, lab: ProjectHandle, arguments: list[str], status: int, told: str
) -> None:
    assert told in run(*arguments, status=status).stderr
    assert clips(lab) == ["raw/a", "raw/b", "raw/c"]


@pytest.mark.usefixtures("shared")
def test_clips_whose_records_cannot_be_changed_are_named_with_the_reason(
    run: Command, lab: ProjectHandle, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: ClipHandle, _info: object) -> None:
        raise Unreachable("the server has stopped")

    monkeypatch.setattr(ClipHandle, "put_info", refuse)
    told = run("record", "lab/raw", "--set", "licence=CC0", status=1).stderr
    assert "3 clips not changed:" in told
    assert "raw/b: the server has stopped" in told


@pytest.mark.usefixtures("shared")
def test_explanations_of_several_kinds_are_one_document(run: Command, lab: ProjectHandle) -> None:
    arguments = ("ls", "lab", "--explain", "--query", "name = a", "--kind", "clip", "--kind", "skeleton", "--json")
    assert len(json.loads(run(*arguments).stdout)) == 2


def test_what_was_removed_is_listed_and_comes_back(run: Command, lab: ProjectHandle) -> None:
    assert "to undo this, run marey restore lab/raw/a" in run("rm", "lab/raw/a").stderr
    run("rm", "lab/raw", "--yes")
    assert clips(lab) == []
    assert "raw/a" not in run("ls", "-r", "lab").stdout
    deleted = json.loads(run("ls", "--deleted", "lab", "--json").stdout)
    assert sorted(f"{one['collection']}/{one['name']}" for one in deleted["items"]) == ["raw/a", "raw/b", "raw/c"]
    assert [one["path"] for one in deleted["collections"]] == ["raw"]
    selected = json.loads(run("ls", "--deleted", "lab", "--kind", "clip", "--query", "name = a", "--json").stdout)
    assert ([one["name"] for one in selected["items"]], selected["collections"]) == (["a"], [])
    run("restore", "lab/raw/")
    assert clips(lab) == ["raw/b", "raw/c"]  # what went with the folder, and not what went before
    run("restore", "lab/raw/a")
    assert clips(lab) == ["raw/a", "raw/b", "raw/c"]


def test_what_was_removed_is_purged_after_a_yes_and_never_comes_back(run: Command, lab: ProjectHandle) -> None:
    ids = {clip.name: clip.id for clip in lab.clips.list()}
    run("rm", "lab/raw/a", "lab/raw/b", "--yes")
    shown = run("purge", "lab/raw", "--preview")
    assert [f"lab/raw/{name}" in shown.stdout for name in "abc"] == [True, True, False]
    assert "2 items would be purged; garbage collection can free about" in shown.stderr
    assert "delete 2 items (lab/raw/" in run("purge", "lab/raw", status=2).stderr
    assert "nothing was purged" in run("purge", "lab/raw/a", terminal="n\n", status=1).stderr
    assert "1 item purged for good" in run("purge", "lab/raw/a", terminal="y\n").stderr
    told = run("restore", f"lab/{ids['a']}", status=2).stderr
    assert f"there is no deleted item or folder at lab/{ids['a']}" in told
    run("restore", "lab/raw/b")
    assert clips(lab) == ["raw/b", "raw/c"]
    assert "there is nothing to purge at lab/raw" in run("purge", "lab/raw", "--yes", status=2).stderr
    run("rm", "lab/raw/b")
    done = json.loads(run("purge", f"lab/{ids['b']}", "--yes", "--json").stdout)
    assert [one["item"] for one in done["purged"]] == [ids["b"]]
    assert done["freed_bytes"] > 0  # other tests have clips with the same poses


def test_an_item_in_a_folder_that_is_purged_too_is_purged_and_counted_once(run: Command, lab: ProjectHandle) -> None:
    item = next(lab.clips.list(path="raw/a")).id
    run("rm", "lab/raw", "--yes")
    alone = json.loads(run("purge", "lab/raw/", "--preview", "--json").stdout)
    both = json.loads(run("purge", "lab/raw/", f"lab/{item}", "--preview", "--json").stdout)
    assert both == alone
    assert "3 items purged for good" in run("purge", "lab/raw/", f"lab/{item}", "--yes").stderr


def test_a_query_and_an_age_select_what_is_purged(run: Command, lab: ProjectHandle) -> None:
    run("record", "lab/raw/b", "--set", "subject=02")
    run("rm", "lab/raw", "--yes")
    assert "there is nothing to purge" in run("purge", "lab", "--older-than", "1", "--yes", status=2).stderr
    assert "1 item purged for good" in run("purge", "lab", "--query", "subject = 02", "--yes").stderr
    run("restore", "lab/raw/")
    assert clips(lab) == ["raw/a", "raw/c"]


def test_what_still_holds_an_item_is_told_and_the_others_are_purged(run: Command, lab: ProjectHandle) -> None:
    run("dataset", "create", "lab/gaits", "--folder", "raw")
    run("dataset", "commit", "lab/gaits", "-m", "first")
    run("rm", "lab/raw/a", "--yes")
    free = lab.clips.create("copy", {"motion": next(lab.clips.list(path="raw/c")).part("motion")}, collection="raw")
    free.delete()
    refused = run("purge", "lab/raw", "--yes", status=1).stderr
    assert re.search(r"lab/raw/a \(clip_\w+\) is still needed by the dataset gaits \(branch main; 1 commit\)", refused)
    assert "1 item purged for good, 1 refused" in refused
    assert "is still needed by" in run("purge", "lab/raw/a", "--preview", status=1).stderr
    run("restore", "lab/raw/a")
    assert clips(lab) == ["raw/a", "raw/b", "raw/c"]


def test_a_deleted_dataset_is_purged_after_a_yes_and_releases_its_items(run: Command, lab: ProjectHandle) -> None:
    run("dataset", "create", "lab/gaits", "--folder", "raw")
    run("dataset", "commit", "lab/gaits", "-m", "first")
    purge = ("purge", "lab", "--dataset", "gaits")
    assert "is not deleted; delete it first" in run(*purge, status=1).stderr
    lab.datasets.at("gaits").delete()
    assert re.search(r"gaits \(dataset_\w+\) would be purged: \d+", run(*purge, "--preview").stderr)
    assert "nothing was purged" in run(*purge, terminal="n\n", status=1).stderr
    assert "give only the project" in run("purge", "lab/raw", "--dataset", "gaits", status=2).stderr
    asked = run(*purge, terminal="y\n").stderr
    assert "delete the dataset gaits with 1 version and 0 proposals for good?" in asked
    assert "was purged for good" in asked
    assert "no deleted dataset" in run(*purge, "--yes", status=1).stderr
    run("rm", "lab/raw/a", "--yes")
    assert "1 item purged for good" in run("purge", "lab/raw/a", "--yes").stderr


def test_of_a_folder_and_a_removed_item_of_one_name_the_address_says_which(run: Command, lab: ProjectHandle) -> None:
    lab.collections.create("raw/a")
    item = next(lab.clips.list(path="raw/a")).id
    run("mv", "lab/raw/b", "lab/raw/a/")
    run("rm", f"lab/{item}")
    run("rm", "lab/raw/a/b")
    assert "lab/raw/a names both a folder and a removed item" in run("purge", "lab/raw/a", "--yes", status=2).stderr
    assert "1 item purged" in run("purge", "lab/raw/a/", "--yes").stderr
    assert "1 item purged" in run("purge", f"lab/{item}", "--yes").stderr
    assert "is the id of a folder" in run("purge", f"lab/collection_{item.partition('_')[2]}", status=2).stderr


def test_of_several_that_were_removed_at_one_place_the_last_comes_back_and_each_by_its_id(
    run: Command, lab: ProjectHandle
) -> None:
    first = next(lab.clips.list(path="raw/a")).id
    run("rm", "lab/raw/a")
    run("mv", "lab/raw/b", "lab/raw/a")
    second = next(lab.clips.list(path="raw/a")).id
    run("rm", "lab/raw/a")
    run("restore", "lab/raw/a")
    assert next(lab.clips.list(path="raw/a")).id == second
    told = run("restore", f"lab/{first}", status=1).stderr
    assert "The collection now contains another clip named 'a'." in told
    assert "first move or rename the item that has this address now, with marey mv" in told
    run("mv", "lab/raw/a", "lab/raw/b")
    run("restore", f"lab/{first}")
    assert next(lab.clips.list(path="raw/a")).id == first


def test_of_things_of_one_name_the_kind_says_which(run: Command, lab: ProjectHandle) -> None:
    skeleton = next(lab.skeletons.list())
    skeleton.change(ItemChange(collection="raw", name="a"))
    assert "several items are called lab/raw/a: a skeleton and a clip" in run("rm", "lab/raw/a", status=2).stderr
    run("mv", "lab/raw/a", "lab/raw/rig", "--kind", "skeleton")
    assert lab.skeletons.get(skeleton.id).path == "raw/rig"
    assert clips(lab) == ["raw/a", "raw/b", "raw/c"]


def test_what_the_server_refuses_of_several_keeps_the_others_from_nothing(run: Command, lab: ProjectHandle) -> None:
    run("mv", "lab/raw/a", "lab/other/c")
    done = run("mv", "lab/raw/b", "lab/raw/c", "lab/other/", "--json", status=1)
    report = json.loads(done.stdout)
    assert [one["name"] for one in report["moved"]] == ["b"]
    assert list(report["refused"]) == ["lab/raw/c"]
    assert clips(lab) == ["other/b", "other/c", "raw/c"]


def test_tags_are_added_and_taken_away(run: Command, lab: ProjectHandle) -> None:
    run("tag", "lab/raw/a", "lab/raw/b", "--add", "slow", "--add", "straight")
    assert "lab/raw/a: straight" in run("tag", "lab/raw/a", "--remove", "slow").stderr
    assert {clip.name: clip.item.tags for clip in lab.clips.list()} == {
        "a": ("straight",), "b": ("slow", "straight"), "c": (),
    }  # fmt: skip
    assert "tags.0" in run("tag", "lab/raw/a", "--add", "a,b", status=2).stderr


def test_take_records_come_from_a_table_and_are_found_by_queries(
    run: Command, lab: ProjectHandle, tmp_path: Path
) -> None:
    table = tmp_path / "takes.csv"
    table.write_text("File,Performer,Action,select\na.bvh,02,Walk slowly,best\nb.bvh,02,run,\n")
    refused = run("record", "lab/raw", "--table", str(table), status=2).stderr
    assert "the column 'Performer' is not a field; give the field that the column" in refused
    assert "--column 'Performer=FIELD'" in refused
    arguments = ("record", "lab/raw", "--table", str(table), "--column", "Performer=subject")
    assert run(*arguments).stderr == "2 records changed, 0 unchanged\n"
    assert run(*arguments).stderr == "0 records changed, 2 unchanged\n"
    listed = json.loads(run("ls", "lab", "--query", "subject = 02 and action ~ WALK", "--json").stdout)
    assert [one["name"] for one in listed["items"]] == ["a"]
    assert {clip.path for clip in lab.clips.list(query="not has select")} == {"raw/b", "raw/c"}
    assert run("record", "lab", "--query", "subject = 02", "--set", "select=good").stderr.startswith(
        "2 records changed"
    )
    run("record", "lab/raw/a", "--set", "select=", "--set", "licence=CC0")
    record = lab.clips.get(next(lab.clips.list(path="raw/a")).id).info()
    assert (record.subject, record.select, record.licence) == ("02", None, "CC0")


def test_what_a_query_selects_is_previewed_removed_after_a_yes_and_counted(run: Command, lab: ProjectHandle) -> None:
    run("record", "lab/raw/b", "--set", "action=run")
    rule = ("lab/raw", "--query", "not action = run")
    listed = run("ls", "lab/raw", "--kind", "clip", *rule[1:]).stdout
    previewed = run("rm", *rule, "--preview")
    assert [name in listed for name in ("raw/a", "raw/b", "raw/c")] == [True, False, True]
    assert [f"lab/raw/{name}" in previewed.stdout for name in "abc"] == [True, False, True]
    assert previewed.stderr == "2 items would be removed; nothing was changed\n"
    assert "remove 2 items (lab/raw/a and 1 more)? This needs a confirmation" in run("rm", *rule, status=2).stderr
    assert "remove 1 item (lab/raw/b)?" in run("rm", "lab", "-q", "action = run", terminal="n\n", status=1).stderr
    assert clips(lab) == ["raw/a", "raw/b", "raw/c"]
    done = run("rm", *rule, "--yes", "--json")
    assert [one["place"] for one in json.loads(done.stdout)["removed"]] == ["lab/raw/a", "lab/raw/c"]
    assert done.stderr == "2 items removed\n"
    assert clips(lab) == ["raw/b"]
    assert [one.name for one in lab.skeletons.list()] != []  # they have no action, but a query selects clips


def test_what_a_query_selects_is_restored_from_removed_folders_too(run: Command, lab: ProjectHandle) -> None:
    run("record", "lab/raw/b", "--set", "action=run")
    run("mv", "lab/raw/c", "lab/day/c")
    run("rm", "lab/raw/a", "lab/raw/b", "lab/day/", "--yes")
    rule = ("--query", "not action = run")
    previewed = run("restore", "lab", *rule, "--preview")
    assert [f"lab/{place}" in previewed.stdout for place in ("raw/a", "raw/b", "day/c")] == [True, False, True]
    assert previewed.stderr == "2 items would be restored; nothing was changed\n"
    assert clips(lab) == []
    done = run("restore", "lab/day", *rule, "--json")
    assert [one["name"] for one in json.loads(done.stdout)["restored"]] == ["c"]
    assert run("restore", "lab", *rule).stderr == "1 item restored\n"
    assert clips(lab) == ["day/c", "raw/a"]


def test_of_several_removed_items_of_one_path_a_query_restores_the_last(
    run: Command, lab: ProjectHandle, takes: Path
) -> None:
    first = next(lab.clips.list(path="raw/a")).id
    run("rm", "lab/raw/a")
    run("mv", "lab/raw/b", "lab/raw/a")
    last = next(lab.clips.list(path="raw/a")).id
    run("rm", "lab/raw/a")
    done = run("restore", "lab", "--query", "name = a")
    assert done.stderr.splitlines()[-1] == "1 item restored"
    assert "left out 1 item with the path of an item that was removed later" in done.stderr
    assert next(lab.clips.list(path="raw/a")).id == last
    refused = run("restore", "lab", "--query", "name = a", status=1)
    assert "first move or rename the item that has this address now" in refused.stderr
    assert {one.id for one in lab.clips.list(deleted=True)} == {first}


def test_what_a_query_selects_is_tagged_from_several_pages(
    run: Command, lab: ProjectHandle, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Items, "list", functools.partialmethod(Items.list, page_size=1))
    run("tag", "lab/raw/a", "--add", "slow")
    previewed = json.loads(run("tag", "lab", "--query", "frames > 1", "--add", "slow", "--preview", "--json").stdout)
    assert [one["place"] for one in previewed["preview"]] == ["lab/raw/b", "lab/raw/c"]  # a has the tag already
    assert "slow" in run("tag", "lab/raw", "--query", "name = b", "--add", "slow", "--preview").stdout
    assert {clip.name: clip.item.tags for clip in lab.clips.list()} == {"a": ("slow",), "b": (), "c": ()}
    done = run("tag", "lab", "lab/raw", "--query", "frames > 1", "--add", "slow")
    assert done.stderr == "1 of 3 items need no change\n2 items changed\n"
    assert {clip.item.tags for clip in lab.clips.list()} == {("slow",)}
    run("tag", "lab", "--query", "name in (b, c)", "--remove", "slow")
    run("rm", "lab", "--query", "tag = slow", "--yes")
    assert clips(lab) == ["raw/b", "raw/c"]


def test_an_item_that_was_changed_since_a_query_selected_it_is_not_removed(
    run: Command, lab: ProjectHandle, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer(_question: str, **_options: object) -> bool:
        next(lab.clips.list(path="raw/b")).change(ItemChange(tags=("keep",)))
        return True

    monkeypatch.setattr(typer, "confirm", answer)
    done = run("rm", "lab", "--query", "not tag = keep", terminal="", status=1)
    assert "lab/raw/b: " in done.stderr
    assert "2 items removed, 1 refused" in done.stderr
    assert clips(lab) == ["raw/b"]


def test_no_item_is_tagged_if_one_would_have_too_many_tags(run: Command, lab: ProjectHandle) -> None:
    next(lab.clips.list(path="raw/c")).change(ItemChange(tags=tuple(f"t{number}" for number in range(64))))
    told = run("tag", "lab", "--query", "frames > 1", "--add", "slow", status=2).stderr
    assert "lab/raw/c cannot have 65 tags" in told
    assert all("slow" not in clip.item.tags for clip in lab.clips.list())


@pytest.mark.usefixtures("shared")
def test_a_query_is_explained_by_what_each_condition_hides(run: Command) -> None:
    shown = run("ls", "lab", "--query", "frames > 1 and name != a", "--explain")
    assert "2 of 3 clips" in shown.stderr
    assert re.search(r"name != a +1 +1", shown.stdout)
    assert re.search(r"frames > 1 +0 +0", shown.stdout)


@pytest.mark.usefixtures("shared")
@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ("clip,select\na,perfect\nnobody,best\n", ["row 2, select", "'perfect'", "row 3: there is no clip 'nobody'"]),
        ("clip,select\na,best\nraw/a,good\n", ["row 3: the clip 'raw/a' is also in row 2"]),
        ("clip,select\na,best,more\n", ["row 2: the row has more cells than the table has columns"]),
        ("name,select\na,best\n", ["needs a column `clip` or `file`"]),
        ("clip,select\n", ["has no rows"]),
        ("clip,shoot_day\na,yesterday\n", ["row 2, shoot_day"]),
        ('clip,select\n"a,best\n', ["cannot be read as a CSV file"]),
    ],
)
def test_a_wrong_table_changes_no_record(
    run: Command, lab: ProjectHandle, tmp_path: Path, rows: str, told: list[str]
) -> None:
    table = tmp_path / "takes.csv"
    table.write_text(rows)
    refused = run("record", "lab/raw", "--table", str(table), status=2).stderr
    assert all(text in refused for text in told), refused
    assert {clip.item.revision for clip in lab.clips.list()} == {1}


@pytest.mark.usefixtures("shared")
@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["ls", "lab", "--query", "frames >"], "query, column 9: the query ends too early"),
        (["ls", "lab", "--explain"], "--explain counts the items that each condition of a query excludes; add --query"),
        (["record", "lab/raw"], "give either values with --set"),
        (["record", "lab/raw", "--set", "selcet=best"], "there is no field 'selcet'"),
        (["record", "lab/raw", "--set", "best"], "'best' has no name and value"),
        (["record", "lab/nothing", "--set", "select=best"], "lab/nothing has no clips"),
    ],
)
def test_wrong_queries_and_records_are_refused(run: Command, arguments: list[str], told: str) -> None:
    status = 1 if "frames >" in arguments else 2
    assert told in run(*arguments, status=status).stderr


@pytest.mark.parametrize(("answer", "status", "left"), [("n\n", 1, ["raw/a", "raw/b", "raw/c"]), ("y\n", 0, [])])
def test_at_a_terminal_many_items_are_removed_after_a_yes(
    run: Command, lab: ProjectHandle, answer: str, status: int, left: list[str]
) -> None:
    assert "remove 3 items (lab/raw/)?" in run("rm", "lab/raw", terminal=answer, status=status).stderr
    assert clips(lab) == left


def test_a_disabled_user_is_let_in_again_and_an_administrator_made(
    run: Command, marey: Marey, lab: ProjectHandle
) -> None:
    run("user", "create", "una", "--without-password")
    assert "marey user enable una" in run("user", "disable", "una").stderr
    assert marey.users.get("una").disabled
    run("user", "enable", "una")
    assert not marey.users.get("una").disabled
    run("user", "change", "una", "--administrator", "--display-name", "Una L.")
    assert (marey.users.get("una").administrator, marey.users.get("una").display_name) == (True, "Una L.")
    run("user", "change", "una", "--no-administrator")
    assert not marey.users.get("una").administrator
    assert "give --display-name, --administrator or both" in run("user", "change", "una", status=2).stderr


def test_quotas_are_shown_and_changed(run: Command, marey: Marey, lab: ProjectHandle) -> None:
    used = lab.quotas().items.used
    assert used > 3
    shown = json.loads(run("project", "quota", "lab", "--items", "3", "--json").stdout)
    assert shown["items"] == {"used": used, "allowed": 3}
    shown = json.loads(run("project", "quota", "lab", "--stored-bytes", "50", "--json").stdout)
    assert (shown["items"]["allowed"], shown["stored_bytes"]["allowed"]) == (3, 50)
    run("tag", "lab/raw/a", "--add", "slow")  # a tag needs no room
    with pytest.raises(Conflict, match=r"the limit is 3, and this needs 1 more.*marey project quota"):
        lab.skeletons.create("more", {"hierarchy": skeleton_tree()})
    lines = run("project", "quota", "lab", "--defaults", "--items", "1000").stdout.splitlines()
    assert [line.split() for line in lines if "items" in line] == [["items", f"{used:,}", "1,000"]]
    assert lab.quotas().stored_bytes.allowed > 50
    assert json.loads(run("project", "quota", "lab", "--running-jobs", "20", "--json").stdout)["running_jobs"] == {
        "used": 0,
        "allowed": 20,
    }
    assert lab.read().most_running_jobs == 20
    assert "no limit" in run("project", "quota", "lab", "--defaults").stdout
    assert lab.read().most_running_jobs is None
    run("user", "create", "quincy", "--without-password")
    assert json.loads(run("user", "quota", "quincy", "--items", "7", "--json").stdout)["items"] == {
        "used": 0,
        "allowed": 7,
    }
    assert marey.users.quotas("quincy").items.allowed == 7


def test_a_path_without_an_item_is_refused_and_an_item_is_listed_by_its_name(run: Command, lab: ProjectHandle) -> None:
    assert "there is no item or folder at lab/rwa; did you mean lab/raw?" in run("ls", "lab/rwa", status=2).stderr
    (item,) = json.loads(run("ls", "lab/raw/a", "--json").stdout)["items"]
    assert (item["kind"], item["name"]) == ("clip", "a")
    assert json.loads(run("ls", "lab/raw", "--tag", "nobody", "--json").stdout) == {"collections": [], "items": []}
    lab.collections.create("empty")
    assert json.loads(run("ls", "lab/empty", "--json").stdout) == {"collections": [], "items": []}

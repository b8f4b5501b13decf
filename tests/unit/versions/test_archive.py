"""Archives: they can be read after writing, an interrupted archive is continued, and every change is detected."""

from __future__ import annotations

import hashlib
import io
import tarfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.tiers import examples

from marey_schemas.encoding.array_differences import ArrayDifference
from marey_schemas.encoding.arrays import ArrayError, EncodedArray
from marey_schemas.encoding.canonical import array_digest, canonical_json
from marey_schemas.encoding.digests import digest_of
from marey_versions.archive.checking import check_archive
from marey_versions.archive.members import MANIFEST, ArchiveMember, BadArchive, MemberKind, differences_member
from marey_versions.archive.reading import Archive, Versions
from marey_versions.archive.writing import ArchiveWriter
from marey_versions.records import CommitRecord, key_of, revision_content
from marey_versions.tree.building import build
from marey_versions.tree.chunks import ChunksInMemory, Value

POSES = np.arange(12, dtype=np.float32).reshape(4, 3)
ORIGINAL = b"HIERARCHY\n"
AT = "2026-11-23T10:00:00.000000Z"


@dataclass
class Example:
    """Archive that tests compose member by member."""

    members: dict[ArchiveMember, bytes] = field(default_factory=dict)
    head: str = ""

    def document(self, tree: dict[str, Any]) -> str:
        data = canonical_json(tree)
        self.members[ArchiveMember(MemberKind.DOCUMENT, digest_of(data))] = data
        return digest_of(data)

    def array(self, values: np.ndarray[Any, Any]) -> dict[str, Any]:
        encoded, digest = EncodedArray.of(values), array_digest(values)
        self.members[ArchiveMember(MemberKind.ARRAY, digest)] = encoded.data
        return {"dtype": encoded.dtype, "shape": list(encoded.shape), "content": digest}

    def revision(self, kind: str, parts: dict[str, str]) -> str:
        content = revision_content(kind, parts)
        self.members[ArchiveMember(MemberKind.REVISION, content)] = canonical_json({"kind": kind, "parts": parts})
        return content

    def commit(self, entries: dict[str, Value], changes: list[dict[str, Any]], *parents: str) -> str:
        tree = build(ChunksInMemory(), sorted(entries.items()))
        record = CommitRecord(tree, parents, "ada", "message", AT)
        self.members[ArchiveMember(MemberKind.COMMIT, record.digest)] = canonical_json(record.document)
        lines = b"".join(canonical_json(one) + b"\n" for one in changes)
        self.members[ArchiveMember(MemberKind.CHANGES, record.digest)] = lines
        self.head = record.digest
        return record.digest

    def write(self, file: io.BytesIO | None = None, base: tuple[str, ...] = ()) -> io.BytesIO:
        file = file or io.BytesIO()
        writer = ArchiveWriter(file)
        for member, data in self.members.items():
            writer.add(member, data)
        writer.finish("gaits", self.head, base)
        return file


def put(path: str, parts: dict[str, str], *tags: str) -> dict[str, Any]:
    return {"path": path, "kind": "clip", "parts": parts, "tags": sorted(tags)}


def example() -> Example:
    """Return an archive of two versions with a clip, whose documents refer to a skeleton and a file.

    The second version changes the tags of the clip and removes another entry.
    """
    made = Example()
    skeleton = made.revision("skeleton", {"hierarchy": made.document({"schema": "marey/skeleton@1", "joints": []})})
    poses = made.array(POSES)
    motion = made.document({"schema": "marey/motion@1", "skeleton": {"content": skeleton}, "poses": poses})
    file = f"sha256:{hashlib.sha256(ORIGINAL).hexdigest()}"
    made.members[ArchiveMember(MemberKind.FILE, file)] = ORIGINAL
    info = made.document({"schema": "marey/clip-info@1", "source": {"file": file, "file_name": "walk.bvh"}})
    walk, other = {"motion": motion, "info": info}, {"motion": motion}
    both = {"parts": walk, "tags": []}, {"parts": other, "tags": []}
    first = made.commit(
        {key_of("a/walk", "clip"): both[0], key_of("b", "clip"): both[1]}, [put("a/walk", walk), put("b", other)]
    )
    tagged = {"parts": walk, "tags": ["good"]}
    removed = {"path": "b", "kind": "clip", "removed": True}
    made.commit({key_of("a/walk", "clip"): tagged}, [put("a/walk", walk, "good"), removed], first)
    return made


def checked(file: io.BytesIO) -> Archive:
    archive = Archive(file)
    check_archive(archive)
    return archive


def test_an_archive_gives_back_versions_documents_arrays_and_files() -> None:
    archive = checked(example().write())
    (_, first), (head, second) = archive.history()
    assert (head, second.parents) == (archive.manifest.commit, (archive.history()[0][0],))
    versions = archive.versions()
    assert [one.path for one in versions.entries(archive.history()[0][0])] == ["a/walk", "b"]
    (entry,) = versions.entries(head)
    assert (entry.path, entry.tags, first.author) == ("a/walk", ("good",), "ada")
    motion = archive.tree(MemberKind.DOCUMENT, entry.parts["motion"])
    assert np.array_equal(archive.array(motion["poses"]["content"]).decode(), POSES)
    info = archive.tree(MemberKind.DOCUMENT, entry.parts["info"])
    assert b"".join(archive.file(info["source"]["file"])) == ORIGINAL


def later_part() -> tuple[Example, dict[str, Any]]:
    """Return an archive of only the second version, and the line that describes its change.

    The changed entry keeps a part from the first version, which the archive lacks.
    """
    whole = example()
    made = Example(head=whole.head)
    line = put("a/walk", {"motion": digest_of(b"motion"), "info": made.document({"schema": "marey/clip-info@1"})})
    line["unchanged"] = {"motion": digest_of(b"revision before")}
    made.members[ArchiveMember(MemberKind.COMMIT, whole.head)] = whole.members[
        ArchiveMember(MemberKind.COMMIT, whole.head)
    ]
    made.members[ArchiveMember(MemberKind.CHANGES, whole.head)] = canonical_json(line) + b"\n"
    return made, line


def test_an_archive_may_have_only_the_later_part_of_a_history() -> None:
    made, line = later_part()
    base = Archive(example().write()).history()[0][0]
    archive = checked(made.write(base=(base,)))
    assert [digest for digest, _ in archive.history()] == [made.head]
    (change,) = archive.changes(made.head).values()
    assert change.unchanged == line["unchanged"]
    with pytest.raises(BadArchive, match=f"only the versions after the commit {base}"):
        archive.versions()
    with pytest.raises(BadArchive, match="commits/"):
        checked(made.write())


def test_a_whole_archive_lacks_no_part() -> None:
    made, line = later_part()
    made.commit({key_of("a/walk", "clip"): {"parts": line["parts"], "tags": []}}, [line])
    del made.members[next(one for one in made.members if one.kind is MemberKind.COMMIT and one.digest != made.head)]
    del made.members[next(one for one in made.members if one.kind is MemberKind.CHANGES and one.digest != made.head)]
    with pytest.raises(BadArchive, match="refers to an earlier archive"):
        checked(made.write())


def test_the_same_members_give_the_same_bytes() -> None:
    assert example().write().getvalue() == example().write().getvalue()


@settings(max_examples=examples(40, soak=100))
@given(st.integers(min_value=0, max_value=20_000))
def test_an_archive_that_was_cut_off_anywhere_is_refused_and_continued(length: int) -> None:
    whole = example().write().getvalue()
    part = io.BytesIO(whole[:length])
    end = whole.index(MANIFEST.encode()) + 512
    if length < end:
        with pytest.raises(BadArchive):
            checked(part)
    example().write(part)
    assert part.getvalue() == whole


def test_what_an_interrupted_attempt_has_written_whole_is_not_written_again() -> None:
    whole = example().write().getvalue()
    members = list(example().members)
    third = whole.index(members[2].name.encode())
    writer = ArchiveWriter(io.BytesIO(whole[: third + 600]))
    assert [member in writer for member in members[:3]] == [True, True, False]


def test_a_member_that_is_there_already_is_not_written_again() -> None:
    file = io.BytesIO()
    writer = ArchiveWriter(file)
    member = ArchiveMember(MemberKind.FILE, digest_of(b"x"))
    writer.add(member, b"x")
    size = file.tell()
    writer.add(member, b"x")
    assert (member in writer, file.tell()) == (True, size)


MEMBERS = sorted(example().members)


@pytest.mark.parametrize("member", MEMBERS, ids=lambda one: one.kind.value)
def test_a_missing_member_is_named(member: ArchiveMember) -> None:
    made = example()
    del made.members[member]
    with pytest.raises(BadArchive, match=member.name):
        checked(made.write())


@pytest.mark.parametrize("member", MEMBERS, ids=lambda one: one.kind.value)
@settings(max_examples=examples(25, soak=100))
@given(data=st.data())
def test_a_changed_byte_is_found_and_the_member_named(member: ArchiveMember, data: st.DataObject) -> None:
    made = example()
    content = bytearray(made.members[member])
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= data.draw(st.integers(1, 255))
    made.members[member] = bytes(content)
    if member.kind is MemberKind.ARRAY:
        try:  # unused bits of a compressed array may change without effect
            same = np.array_equal(EncodedArray("<f4", POSES.shape, bytes(content)).decode(), POSES)
        except ArrayError:
            same = False
        if same:
            return
    with pytest.raises(BadArchive, match=member.name):
        checked(made.write())


@pytest.mark.parametrize("spaced", [lambda data: data[:-1] + b"\t", lambda data: b" " + data], ids=["end", "start"])
def test_changes_that_another_program_has_written_otherwise_are_refused(spaced: Callable[[bytes], bytes]) -> None:
    made = example()
    member = ArchiveMember(MemberKind.CHANGES, made.head)
    made.members[member] = spaced(made.members[member])
    with pytest.raises(BadArchive, match=f"{member.name}: the lines are not in canonical form"):
        checked(made.write())


def added_member(made: Example) -> None:
    made.members[ArchiveMember(MemberKind.FILE, digest_of(b"more"))] = b"more"


def broken_text(made: Example) -> None:
    member = ArchiveMember(MemberKind.CHANGES, made.head)
    made.members[member] = made.members[member].replace(b"good", b"\\ud800")


def other_shape(made: Example) -> None:
    made.commit({key_of("c", "clip"): {"parts": {"motion": bad_document(made)}, "tags": []}},
                [put("c", {"motion": bad_document(made)})])  # fmt: skip


def bad_document(made: Example) -> str:
    leaf = made.array(POSES) | {"shape": [3, 4]}
    return made.document({"schema": "marey/motion@1", "poses": leaf})


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (added_member, "added later; export the archive again"),
        (broken_text, "not a list of changes"),
        (other_shape, "the dtype or shape given here differs"),
    ],
)
def test_an_archive_with_more_or_other_things_than_its_versions_is_refused(
    damage: Callable[[Example], None], message: str
) -> None:
    made = Example() if damage is other_shape else example()
    damage(made)
    with pytest.raises(BadArchive, match=message):
        checked(made.write())


def tar_of(*members: tuple[tarfile.TarInfo, bytes]) -> io.BytesIO:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w:") as tar:
        for header, data in members:
            header.size = len(data)
            tar.addfile(header, io.BytesIO(data))
    return file


def manifest(schema: str) -> tuple[tarfile.TarInfo, bytes]:
    return tarfile.TarInfo(MANIFEST), canonical_json({"schema": schema, "dataset": "d", "commit": "c", "base": []})


def link() -> tarfile.TarInfo:
    header = tarfile.TarInfo(MEMBERS[0].name)
    header.type, header.linkname = tarfile.SYMTYPE, "/etc/passwd"
    return header


@pytest.mark.parametrize(
    ("file", "message"),
    [
        (io.BytesIO(b""), "no archive.json|not an archive, or its content"),
        (io.BytesIO(b"GIF89a" * 200), "not an archive"),
        (
            tar_of((tarfile.TarInfo("../evil"), b"x")),
            "no member of an archive has such a name.*export the archive again",
        ),
        (tar_of((link(), b"")), "not a regular file.*export it again"),
        (tar_of((tarfile.TarInfo(MEMBERS[0].name), b"1"), (tarfile.TarInfo(MEMBERS[0].name), b"1")), "two members"),
        (tar_of((tarfile.TarInfo(MANIFEST), b"[]")), "not the manifest"),
        (
            tar_of(manifest("marey/archive@9")),
            "update",
        ),
        (
            tar_of(manifest("marey/archive@1")),
            "digest",
        ),
    ],
)
def test_a_file_that_is_no_archive_is_refused(file: io.BytesIO, message: str) -> None:
    with pytest.raises(BadArchive, match=message):
        checked(file)


def with_changes(made: Example, line: dict[str, Any]) -> None:
    made.members[ArchiveMember(MemberKind.CHANGES, made.head)] = canonical_json(line) + b"\n"


def with_odd_tag(made: Example) -> None:
    with_changes(made, {**put("a", {}), "tags": [1]})


def with_odd_commit(made: Example) -> None:
    made.members = {ArchiveMember(MemberKind.COMMIT, digest_of(b"[]")): b"[]"}
    made.head = digest_of(b"[]")


def with_odd_revision(made: Example) -> None:
    made.members[ArchiveMember(MemberKind.REVISION, digest_of(b"[]"))] = b"[]"
    refer(made, digest_of(b"[]"))


def with_spaces(made: Example) -> None:
    data = b'{"schema": "marey/motion@1"}'
    made.members[ArchiveMember(MemberKind.DOCUMENT, digest_of(data))] = data
    made.commit({key_of("c", "clip"): {"parts": {"motion": digest_of(data)}, "tags": []}},
                [put("c", {"motion": digest_of(data)})])  # fmt: skip


def refer(made: Example, content: str) -> None:
    motion = made.document({"schema": "marey/motion@1", "skeleton": {"content": content}})
    made.commit({key_of("c", "clip"): {"parts": {"motion": motion}, "tags": []}}, [put("c", {"motion": motion})])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (with_odd_tag, "not a list of changes; export the archive again"),
        (with_odd_commit, "not the record of a commit"),
        (with_odd_revision, "does not describe a revision"),
        (with_spaces, "not in canonical form.*export the archive again"),
    ],
)
def test_members_of_the_right_digest_and_another_form_are_refused(
    damage: Callable[[Example], None], message: str
) -> None:
    made = Example() if damage in (with_odd_revision, with_spaces) else example()
    damage(made)
    with pytest.raises(BadArchive, match=message):
        checked(made.write())


def test_members_that_two_documents_share_are_read_once() -> None:
    made = Example()
    poses = made.array(POSES)
    file = digest_of(ORIGINAL)
    made.members[ArchiveMember(MemberKind.FILE, file)] = ORIGINAL
    infos = [
        made.document({"schema": "marey/clip-info@1", "comment": text, "source": {"file": file}, "poses": poses})
        for text in ("a", "b")
    ]
    entries = {key_of(one, "clip"): {"parts": {"info": one}, "tags": []} for one in infos}
    made.commit(entries, [put(one, {"info": one}) for one in infos])
    assert len(checked(made.write()).members) == 6


def test_files_of_earlier_versions_may_be_missing_from_a_later_part() -> None:
    made = Example()
    info = made.document({"schema": "marey/clip-info@1", "source": {"file": digest_of(ORIGINAL)}})
    made.commit({key_of("c", "clip"): {"parts": {"info": info}, "tags": []}}, [put("c", {"info": info})], AT_BASE)
    assert checked(made.write(base=(AT_BASE,))).manifest.base == (AT_BASE,)
    with pytest.raises(BadArchive):
        checked(made.write())


AT_BASE = digest_of(b"a commit before")


def test_nothing_comes_after_the_manifest_and_large_members_are_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    member = (tarfile.TarInfo(MEMBERS[0].name), b"1")
    complete = (tarfile.TarInfo(MANIFEST), canonical_json({
        "schema": "marey/archive@1", "dataset": "d", "commit": AT_BASE, "base": [],
    }))  # fmt: skip
    with pytest.raises(BadArchive, match=r"the member follows.*export it again"):
        checked(tar_of(complete, member))
    file = example().write()
    monkeypatch.setattr("marey_versions.archive.reading.MOST_BYTES", 10)
    with pytest.raises(BadArchive, match=r"at most 10 are accepted.*export it again"):
        checked(file)


def test_facets_are_read_and_belong_to_revisions_of_the_archive() -> None:
    content = next(member.digest for member in example().members if member.kind is MemberKind.REVISION)

    def with_facets(tree: Any) -> io.BytesIO:
        made, data = example(), canonical_json(tree)
        made.members[ArchiveMember(MemberKind.FACETS, digest_of(data))] = data
        return made.write()

    facets = {content: {"usage": 0.5, "used_frames": 1}}
    assert checked(with_facets(facets)).facets() == facets
    assert checked(example().write()).facets() == {}
    stranger = digest_of(b"another revision")
    with pytest.raises(BadArchive, match=f"^facets/.*no version in the archive contains the revision {stranger}"):
        checked(with_facets({stranger: {"usage": 0.5}}))
    wrong: list[Any] = [[], {content: 1}, {"no digest": {}}]
    wrong += [{content: values} for values in ({"usage": "much"}, {"usage": True}, {"No name": 1.0}, {"usage\n": 1.0})]
    for tree in wrong:
        with pytest.raises(BadArchive, match="not a list of facets; export the archive again"):
            checked(with_facets(tree))


def test_a_number_that_no_double_can_represent_is_no_json_of_an_archive() -> None:
    made, data = example(), b'{"usage":1%s}' % (b"0" * 400)
    made.members[ArchiveMember(MemberKind.FACETS, digest_of(data))] = data
    with pytest.raises(BadArchive, match=r"^facets/.* is not JSON.*export the archive again"):
        checked(made.write())


def test_only_archives_with_facets_have_the_newer_schema() -> None:
    """A program that does not know facets then says that it must be updated, and not that a member is damaged."""
    content = next(member.digest for member in example().members if member.kind is MemberKind.REVISION)
    made, data = example(), canonical_json({content: {"usage": 0.5}})
    made.members[ArchiveMember(MemberKind.FACETS, digest_of(data))] = data
    for written, schema in ((example(), b"marey/archive@1"), (made, b"marey/archive@2")):
        assert schema in written.write().getvalue()


def first_commit() -> tuple[str, ...]:
    """Return the commit on which the archive of `later_part` builds."""
    return (Archive(example().write()).history()[0][0],)


def with_difference(**changed: Any) -> tuple[Example, str]:
    """Return an archive of a later version whose clip has its poses as a difference; and the digest of the document.

    `changed` are members of the difference that are replaced.
    """
    made, line = later_part()
    edited = POSES.copy()
    edited[1] += 1
    digest = array_digest(edited)
    leaf = {"dtype": "<f4", "shape": [4, 3], "content": digest}
    motion = made.document({"schema": "marey/motion@1", "poses": leaf})
    found = ArrayDifference(
        base=digest_of(b"revision before"), pointer="/poses", dtype="<f4", shape=(4, 3), digest=digest,
        frames=np.array([1], "<u4"), difference=np.ones((1, 3), "<u4"),
    )  # fmt: skip
    made.members[ArchiveMember(MemberKind.DIFFERENCES, motion)] = differences_member([replace(found, **changed)])
    del line["unchanged"]
    line["parts"]["motion"] = motion
    made.members[ArchiveMember(MemberKind.CHANGES, made.head)] = canonical_json(line) + b"\n"
    return made, motion


def test_an_archive_of_later_versions_may_have_arrays_as_differences() -> None:
    """Programs that do not know array differences refuse the schema of such an archive."""
    made, motion = with_difference()
    archive = checked(made.write(base=first_commit()))
    (found,) = archive.differences(motion).values()
    assert isinstance(found.difference, np.ndarray)
    assert np.array_equal(found.difference, np.ones((1, 3)))
    assert archive.differences(digest_of(b"other")) == {}
    assert b'"marey/archive@3"' in made.write(base=first_commit()).getvalue()


def test_an_archive_with_the_whole_history_or_a_damaged_difference_is_refused() -> None:
    base = first_commit()
    made, motion = with_difference()
    name = ArchiveMember(MemberKind.DIFFERENCES, motion)
    with pytest.raises(BadArchive, match=r"differences/.*must contain whole arrays; export the archive again"):
        Archive(made.write()).differences(motion)
    with pytest.raises(
        BadArchive, match=r"dtype or shape given here differs from that of the array differences/.*export"
    ):
        checked(with_difference(shape=(5, 3))[0].write(base=base))
    with pytest.raises(BadArchive, match=r"arrays/.*no such member"):
        checked(with_difference(digest=digest_of(b"other"))[0].write(base=base))
    data = made.members[name]
    for damaged in (data[:-1], b"", b"\x00", b"\x91\x01", data[:-9] + bytes(9)):
        made.members[name] = damaged
        with pytest.raises(BadArchive, match="differences/"):
            checked(made.write(base=base))
    made.members[name] = data
    made.members[ArchiveMember(MemberKind.DIFFERENCES, digest_of(b"other"))] = data
    with pytest.raises(BadArchive, match="no version in the archive contains this member"):
        checked(made.write(base=base))


def test_an_entry_of_a_kind_that_is_not_known_yet_is_named() -> None:
    store = ChunksInMemory()
    root = build(store, [(key_of("a", "painting"), {"parts": {}, "tags": []})])
    with pytest.raises(BadArchive, match=r"painting.*update Marey"):
        list(Versions(store, {"commit": root}).entries("commit"))

"""Natural mistakes at the command line: each is answered in plain words that say what is wrong and what to do."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from tests.support.command_line import CommandLine

from marey_client.project import ProjectHandle

CLUMSY = re.compile(
    r"Traceback|Value error|Input should|valid (integer|string|number|dictionary)|not permitted|Errno|\^\[|object at 0x"
)
"""Words of programs that no answer to a mistake may contain."""

MISTAKES: tuple[tuple[str, int, str], ...] = (
    # a file or a folder on this machine
    ("upload takez --project lab", 1, "takez does not exist"),
    ("upload -rf.bvh --project lab", 2, "for the file of this name, write ./-rf.bvh"),
    ("upload empty.bvh --project lab", 1, "the file is empty"),
    ("upload fbx.bvh --project lab", 1, "convert the motion to BVH"),
    ("upload page.bvh --project lab", 1, "a BVH file begins with HIERARCHY"),
    ("upload half.bvh --project lab", 1, "half.bvh:"),
    ("archive create lab/gaits half.bvh", 1, "half.bvh exists and is not an archive, so it is not replaced"),
    ("view 'lab/walks/walk 1 0' --out half.bvh/v.png", 1, "half.bvh exists already, as a file"),
    ("download 'lab/walks/walk 1 0' -o half.bvh", 1, "half.bvh exists already, as a file; choose another name"),
    ("ls lab --token-file nowhere.token", 1, "nowhere.token cannot be read"),
    # units, axes, rates, and other values
    ("upload half.bvh --project lab --unit inches", 2, "did you mean 'inch'?"),
    ("upload half.bvh --project lab --fps 29,97", 2, "the value must be a number, with a decimal point: 29.97"),
    ("upload half.bvh --project lab --fps 0", 2, "--frame-rate-hz: the value must be above 0"),
    ("upload half.bvh --project lab --tag a,b", 2, "the text must contain no comma and no control characters"),
    ("upload half.bvh --project lab --collection ../x", 2, "must not contain . or .."),
    ("upload half.bvh --project lab --collection lab/raw", 1, "for lab/raw, give --collection raw"),
    ("model lab/walks --into models --criterion BIC", 2, "did you mean 'bic'?"),
    ("evaluate lab/walks --families circel", 2, "did you mean 'circle'?"),
    ("view 'lab/walks/walk 1 0' --out v.png --frames 20:10", 2, "with the first frame before the end"),
    ("token create t --scope read --days 100000", 2, "'--days': the value must be at most 3650"),
    ("token create t --scope raed", 2, "one of the scopes read, write, jobs, work, admin"),
    ("member put lab admin writer", 2, "'reader', 'contributor', 'maintainer' or 'owner'"),
    ("user create Jürgen", 2, "name: the text must have at most 64 lower-case letters"),
    ("edit apply 'lab/walks/walk 1 0' --into e --in-place --do smooth", 2, "cannot be combined with --into"),
    ("edit apply 'lab/walks/walk 1 0' --into e --do 'trim start=five'", 2, "start: the value must be a whole number"),
    # projects, folders and items
    ("ls lba", 1, "; did you mean lab?"),
    ("upload half.bvh --project lab/walks", 2, "'lab', and the folder 'walks' apart from it"),
    ("ls ./lab/walks", 2, "did you mean 'lab/walks'?"),
    ("ls .", 2, "'.' is not the address of a folder or an item; write project/folder/name"),
    (r"show 'lab\walks\x'", 2, "did you mean 'lab/walks/x'?"),
    ("ls lab/wakls", 2, "there is no item or folder at lab/wakls; did you mean lab/walks?"),
    ("show 'lab/walks/walk 1 0.bvh'", 2, "did you mean 'lab/walks/walk 1 0'?"),
    ("show 'lab/walks/Walk 1 0'", 2, "did you mean 'lab/walks/walk 1 0'?"),
    ("show 'lab/wakls/walk 1 0'", 2, "did you mean 'lab/walks/walk 1 0'?"),
    ("mv 'lab/walks/walk 1 0' lab/walks/../walk", 2, "must not contain . or .."),
    ("edit apply 'lab/walks/walk 1 0' --into ../x --do mirror", 1, "must not contain . or .."),
    ("view 'lab/walks/walk 1 0' --out v.html --frames 20:10", 1, "with the first frame before the end"),
    ("diff 'lab/walks/walk 1 0'", 1, "no revision before revision 1; compare it with another item"),
    ("show lab/walks/run", 2, "`marey ls lab/walks` lists the folder"),
    ("download lab/skeletons", 2, "`marey ls lab/skeletons` lists the folder"),
    ("show 'lab/walks/walk 1 0@9'", 1, "has no revision 9; the newest is revision 1"),
    ("show 'lab/walks/walk 1 0' --part motoin", 1, "a clip can have the parts motion, info"),
    (
        "retarget lab/walks --to 'lab/walks/walk 1 0' --into x",
        2,
        "there is no skeleton at lab/walks/walk 1 0, but a clip; `marey show 'lab/walks/walk 1 0'` shows it",
    ),
    ("edit apply 'lab/walks/walk 1 o' --into e --do mirror", 2, "did you mean 'lab/walks/walk 1 0'?"),
    ("quality lab/wakls", 2, "there is no clip and no folder at lab/wakls; did you mean lab/walks?"),
    ("model lab/walks --into models", 1, "contains no aligned clip; align its clips first"),
    ("why lab/walks", 2, "'lab/walks' is not the id of a job"),
    # unknown words
    ("uplaod half.bvh --project lab", 2, "Did you mean 'upload'?"),
    ("commit", 2, "Type: marey dataset commit"),
    ("upload half.bvh --project lab --colection raw", 2, "--collection"),
    ("ls lab --kind clps", 2, "did you mean 'clip'?"),
    ("job submit lab retraget", 2, "did you mean 'retarget'?"),
    ("edit commands smoth", 2, "did you mean 'smooth'?"),
    ("script register lab s --file s.json", 2, "comit: there is no field of this name"),
)
"""Commands after `marey`, each with its exit status and a part of the answer."""


def test_every_mistake_gets_an_answer_in_plain_words(lab: ProjectHandle, run: CommandLine, tmp_path: Path) -> None:
    lab.datasets.create("gaits", collection="walks").commit("first")
    before = (tmp_path / "takes" / "walk 1 0.bvh").read_bytes()
    half = before[: len(before) // 2]
    files = {"empty.bvh": b"", "fbx.bvh": b"Kaydara FBX Binary  \0", "page.bvh": b"<!DOCTYPE html>", "-rf.bvh": before}
    for name, content in {**files, "half.bvh": half, "s.json": b'{"comit": "abc"}'}.items():
        (tmp_path / name).write_bytes(content)
    clips = len(lab.clips)
    wrong = []
    for line, status, answer in MISTAKES:
        try:
            done = run(*shlex.split(line), status=status)
        except Exception as error:  # also one that the command line does not expect
            wrong.append(f"{line}: {error}")
            continue
        if answer not in done.stderr or CLUMSY.search(done.stderr):
            wrong.append(f"{line}: {done.stderr}")
    assert not wrong, "\n".join(wrong)
    assert (len(lab.clips), (tmp_path / "half.bvh").read_bytes()) == (clips, half)

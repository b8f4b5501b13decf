"""Command `skeleton map`: assignments of joints as text on the command line."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from tests.support.command_line import run_here

from marey_client.cli import skeletons
from marey_client.cli.skeletons import _assigned
from marey_client.cli.terminal.failures import WrongUsage

KNOWN = {"Foot_L", "Foot_R", "Hips"}
MAPPED = {"left_ankle": "Foot_L", "leftankle": "Foot_L"}


@pytest.mark.parametrize(
    ("assignment", "told"),
    [
        ("leftfoot=Foot_L", "'leftfoot' is not a standard joint; did you mean left_"),
        ("leftankle=Foot_L", "'leftankle' is not a standard joint; did you mean left_ankle"),
        ("tail=Hips", "'tail' is not a standard joint; it must be one of root, pelvis, "),
        ("tail=", "'tail' is not a standard joint"),
        ("left_ankle=Foot-L", "'Foot-L' is not a joint of this skeleton; did you mean Foot_"),
        ("left_ankle", "write standard_joint=JointName"),
    ],
)
def test_a_typing_error_is_answered_with_the_nearest_name(assignment: str, told: str) -> None:
    with pytest.raises(WrongUsage) as refused:
        _assigned([assignment], KNOWN, MAPPED)
    assert told in str(refused.value)


def test_a_name_that_is_not_standard_can_be_cleared() -> None:
    assert _assigned(["leftankle="], KNOWN, MAPPED) == {"leftankle": ""}


class NoServer:
    def __enter__(self) -> NoServer:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def project(self, _: str) -> None:
        pass


@pytest.mark.parametrize("change", [[], ["--twist", "1,0,0"], ["--twist", "1,0,0", "--swing", "0,1,0"]])
def test_axes_of_a_joint_that_the_skeleton_lacks_are_refused(
    change: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    skeleton = SimpleNamespace(
        mapping=lambda: SimpleNamespace(axes={}),
        hierarchy=lambda: SimpleNamespace(joints=[SimpleNamespace(name=name) for name in sorted(KNOWN)]),
    )
    monkeypatch.setattr(skeletons, "connect", lambda context: NoServer())
    monkeypatch.setattr(skeletons, "require_item", lambda *_: skeleton)
    done = run_here(["skeleton", "axes", "lab/b", "Foot_X", *change])
    assert done.returncode == 2
    assert "'Foot_X' is not a joint of this skeleton; did you mean Foot_" in done.stderr


def test_one_skeleton_alone_is_not_merged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(skeletons, "connect", lambda context: NoServer())
    monkeypatch.setattr(skeletons, "require_item", lambda *_: SimpleNamespace(id="skeleton_b"))
    for words in (["lab/b"], ["lab/b", "lab/b"], ["lab/b", "--keep", "lab/b"]):
        done = run_here(["skeleton", "merge", *words])
        assert done.returncode == 2
        assert "marey skeleton merge lab --keep lab/b" in done.stderr

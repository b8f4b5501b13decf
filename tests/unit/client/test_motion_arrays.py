"""Arrays of joints whose names a request cannot contain, and tables of these arrays."""

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.support.scripted_server import ScriptedServer

from marey_client.errors import BadArgument, NoSuchJoint
from marey_client.poses import frame_tables
from marey_client.poses.handle import PosesHandle
from marey_schemas.encoding.codecs import encode_tree
from marey_schemas.items import Item
from marey_schemas.sizes import MOST_QUERY_VALUES

MANY = tuple(f"joint {number}" for number in range(MOST_QUERY_VALUES + 44))
FRAMES = 2


def a_clip(script: ScriptedServer, joints: tuple[str, ...]) -> PosesHandle:
    """Return the handle of a clip that the server sends whole; each number of its poses is the number's column."""
    item = {
        "id": "clip_1", "kind": "clip", "name": "walk", "collection": "", "revision": 1, "rev": 1,
        "created_at": "2026-01-01T00:00:00Z", "updated_at": "2026-01-01T00:00:00Z",
        "summary": {"joints": len(joints), "frames": FRAMES, "frame_rate_hz": 30.0},
    }  # fmt: skip
    poses = np.tile(np.arange(3 + 4 * len(joints), dtype=np.float32), (FRAMES, 1))
    motion = {
        "schema": "marey/motion@1", "skeleton": {"item": "skeleton_1", "revision": 1}, "frame_rate_hz": 30.0,
        "joints": list(joints), "poses": poses, "translated_joints": list(joints[1:3]),
        "translations": np.tile(np.array([[1.0], [2.0]], np.float32), (FRAMES, 1, 3)),
    }  # fmt: skip
    body = encode_tree(motion, "application/msgpack", arrays="blocks")
    script.answers = [httpx.Response(200, content=body, headers={"Content-Type": "application/msgpack; arrays=blocks"})]
    return PosesHandle(script.marey().transport, "lab", Item.model_validate(item))


@pytest.mark.parametrize(
    ("joints", "wanted"),
    [
        (MANY, MANY[::-1]),  # more names than a query parameter may have
        (("Hips", "left, upper", "left, lower"), ("left, lower", "Hips")),  # commas, which separate names
        (tuple(f"{number:0>250}" for number in range(20)), tuple(f"{number:0>250}" for number in range(19, 1, -1))),
    ],
)
def test_joints_that_a_request_cannot_name_are_chosen_after_reading(
    script: ScriptedServer, joints: tuple[str, ...], wanted: tuple[str, ...]
) -> None:
    motion = a_clip(script, joints).motion(joints=wanted)
    assert "joints" not in script.requests[0].url.params
    assert motion.joints == wanted
    assert motion.root_translations.tolist() == [[0.0, 1.0, 2.0]] * FRAMES
    assert motion.rotations[1, :, 0].tolist() == [3.0 + 4 * joints.index(name) for name in wanted]
    moved = [name for name in joints[1:3] if name in wanted]
    assert motion.translated_joints == tuple(moved)
    expected = [[float(joints.index(name))] * 3 for name in moved]
    assert ([] if motion.translations is None else motion.translations[0].tolist()) == expected


@pytest.mark.parametrize(("wanted", "error"), [(["a,b"], NoSuchJoint), ([MANY[0]] * 300, BadArgument)])
def test_joints_that_cannot_be_chosen_are_refused(
    script: ScriptedServer, wanted: list[str], error: type[Exception]
) -> None:
    with pytest.raises(error):
        a_clip(script, MANY).motion(joints=wanted)


@pytest.mark.parametrize("joint", ["frame", "time_s"])
def test_a_joint_never_replaces_another_column_of_a_table(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, joint: str
) -> None:
    def positions(_clip: object, names: tuple[str, ...], _frames: object) -> NDArray[np.float32]:
        return np.zeros((FRAMES, len(names), 3), np.float32)

    monkeypatch.setattr(frame_tables, "read_positions", positions)
    clip = a_clip(script, ("Hips", joint))
    with pytest.raises(BadArgument, match=f"the joint '{joint}' has the name of another column"):
        clip.to_arrow(joints=["Hips", joint])
    assert clip.to_arrow(joints=["Hips"]).column_names == ["frame", "time_s", "Hips"]

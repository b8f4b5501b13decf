"""Python SDK and the `marey` command.

    from marey_client import Marey

    lab = Marey("http://127.0.0.1:8460").project("lab")
    for clip in lab.clips.list(collection="raw"):
        motion = clip.motion(frames=slice(0, 120), joints=["Hips", "LeftFoot"])
        motion.rotations  # (120, 2, 4) float32

Each name is loaded when it is first used, so that `marey --help` does not load numpy and httpx.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from marey_client.marey import Marey as Marey
    from marey_client.project import ProjectHandle as ProjectHandle

_HOMES = {"Marey": "marey_client.marey", "ProjectHandle": "marey_client.project"}

__all__ = ["Marey", "ProjectHandle"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"the module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)

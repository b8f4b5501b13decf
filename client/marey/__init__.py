"""Python SDK of Marey under a short name: `import marey`.

    import marey

    lab = marey.connect().project("lab")
    lab.upload("takes", collection="raw")
    for clip in lab.clips:
        print(clip.path, clip.frames, clip.positions(joints=["LeftFoot"], frames=slice(0, 120)).shape)

Programs with an event loop call `connect_async` instead of `connect`; the methods have the same names and are awaited.

The classes are those of the package `marey_client`, which also contains less frequently used parts. Each name is loaded
when it is first used, so that the import takes hardly any time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from marey_client.asynchronous.marey import AsyncMarey as AsyncMarey
    from marey_client.asynchronous.marey import connect_async as connect_async
    from marey_client.credentials import TokenFile as TokenFile
    from marey_client.errors import JobUnsuccessful as JobUnsuccessful
    from marey_client.errors import MareyError as MareyError
    from marey_client.marey import Marey as Marey
    from marey_client.marey import connect as connect
    from marey_client.poses.windows import MotionWindows as MotionWindows

_HOMES = {
    "AsyncMarey": "marey_client.asynchronous.marey",
    "JobUnsuccessful": "marey_client.errors",
    "Marey": "marey_client.marey",
    "MareyError": "marey_client.errors",
    "MotionWindows": "marey_client.poses.windows",
    "TokenFile": "marey_client.credentials",
    "connect": "marey_client.marey",
    "connect_async": "marey_client.asynchronous.marey",
}

__all__ = [
    "AsyncMarey",
    "JobUnsuccessful",
    "Marey",
    "MareyError",
    "MotionWindows",
    "TokenFile",
    "connect",
    "connect_async",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"the module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)

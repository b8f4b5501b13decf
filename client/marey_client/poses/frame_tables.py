"""Motions as tables and labelled arrays: pandas, pyarrow, xarray."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_client.arguments import several
from marey_client.errors import BadArgument
from marey_client.extras import import_optional
from marey_client.listing.tables import TABLES_EXTRA
from marey_client.poses.arrays import Joints, PosedItem
from marey_client.poses.kinematics import read_positions

AXES = ("x", "y", "z")
FACT_COLUMNS = ("frame", "time_s")
"""Columns of tables of pyarrow that are not joints."""


def to_dataframe(clip: PosedItem, joints: Joints, frames: slice | None) -> Any:
    """Return positions as a pandas table with the times as index, and the joints and axes as columns."""
    pandas = import_optional("pandas", TABLES_EXTRA)
    names, positions = _named_positions(clip, joints, frames)
    table = pandas.DataFrame(
        positions.reshape(len(positions), -1),
        index=pandas.Index(_times_s(clip, positions, frames), name="time_s"),
        columns=pandas.MultiIndex.from_product([names, AXES], names=["joint", "axis"]),
    )
    table.attrs |= _facts(clip)
    return table


def to_arrow(clip: PosedItem, joints: Joints, frames: slice | None) -> Any:
    """Return positions as a table of pyarrow, with one column of three numbers for each joint."""
    arrow = import_optional("pyarrow", TABLES_EXTRA)
    names, positions = _named_positions(clip, joints, frames)
    if taken := [name for name in names if name in FACT_COLUMNS]:
        raise BadArgument(
            f"joints: the joint {taken[0]!r} has the name of another column of the table; leave it out, or use "
            "to_dataframe, whose columns are pairs of joint and axis"
        )
    first = _first(frames)
    columns = {
        "frame": arrow.array(np.arange(first, first + len(positions))),
        "time_s": arrow.array(_times_s(clip, positions, frames)),
    }
    for place, name in enumerate(names):
        numbers = arrow.array(np.ascontiguousarray(positions[:, place]).ravel())
        columns[name] = arrow.FixedSizeListArray.from_arrays(numbers, len(AXES))
    table = arrow.Table.from_arrays(list(columns.values()), names=list(columns))
    return table.replace_schema_metadata({name: str(value) for name, value in _facts(clip).items()})


def to_xarray(clip: PosedItem, joints: Joints, frames: slice | None) -> Any:
    """Return positions and local rotations as a dataset of xarray."""
    xarray = import_optional("xarray", TABLES_EXTRA)
    names, positions = _named_positions(clip, joints, frames)
    return xarray.Dataset(
        {
            "positions": (("time_s", "joint", "axis"), positions, {"units": "m"}),
            "rotations": (("time_s", "joint", "component"), clip.rotations(joints=names, frames=frames)),
        },
        coords={
            "time_s": _times_s(clip, positions, frames),
            "joint": list(names),
            "axis": list(AXES),
            "component": ["w", *AXES],
        },
        attrs=_facts(clip),
    )


def _named_positions(
    clip: PosedItem, joints: Joints, frames: slice | None
) -> tuple[tuple[str, ...], NDArray[np.float32]]:
    names = clip.joints() if joints is None else several(joints)
    return names, read_positions(clip, names, frames)


def _times_s(clip: PosedItem, positions: NDArray[np.float32], frames: slice | None) -> NDArray[np.float64]:
    first = _first(frames)
    return np.arange(first, first + len(positions)) / clip.frame_rate_hz


def _first(frames: slice | None) -> int:
    return 0 if frames is None else frames.start or 0


def _facts(clip: PosedItem) -> dict[str, Any]:
    return {
        "clip": clip.path, "id": clip.id, "revision": clip.item.revision, "frame_rate_hz": clip.frame_rate_hz,
        "unit": "m", "up": "y",
    }  # fmt: skip

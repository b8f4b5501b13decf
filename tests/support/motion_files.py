"""Synthetic motion files, composed of short texts so that tests can damage each in one place."""

from __future__ import annotations

from collections.abc import Sequence

POSITIONS = "Xposition Yposition Zposition"
ZXY = "Zrotation Xrotation Yrotation"

ARM = f"""HIERARCHY
ROOT Hips
{{
  OFFSET 0 90 0
  CHANNELS 6 {POSITIONS} {ZXY}
  JOINT Arm
  {{
    OFFSET 0 10 0
    CHANNELS 3 {ZXY}
    End Site
    {{
      OFFSET 0 5 0
    }}
  }}
}}
"""


def rows_of(values: Sequence[Sequence[float]]) -> list[str]:
    """Return rows of numbers as lines of text, with six decimals."""
    return [" ".join(f"{value:.6f}" for value in row) for row in values]


def bvh(
    rows: Sequence[str] = ("0 0 0 0 0 0 0 0 0",),
    *,
    hierarchy: str = ARM,
    frames: int | str | None = None,
    frame_time: str = "0.01",
) -> bytes:
    """Return a BVH file with `rows` as lines of numbers; its header declares `frames` frames, or one for each row."""
    declared = len(rows) if frames is None else frames
    return (
        hierarchy + f"MOTION\nFrames: {declared}\nFrame Time: {frame_time}\n" + "".join(f"{r}\n" for r in rows)
    ).encode()


def nested(names: Sequence[str], channels: Sequence[str], *, tip: bool = True) -> str:
    """Return a HIERARCHY of joints one below the other, each 10 units above its parent."""
    lines = ["HIERARCHY"]
    for depth, (name, own) in enumerate(zip(names, channels, strict=True)):
        words = own.split()
        lines += [f"{'JOINT' if depth else 'ROOT'} {name}", "{", "OFFSET 0 10 0", f"CHANNELS {len(words)} {own}"]
    if tip:
        lines += ["End Site", "{", "OFFSET 0 10 0", "}"]
    return "\n".join([*lines, *"}" * len(names)]) + "\n"


ASF = """# made up
:version 1.10
:name made-up
:units
  mass 1.0
  length 0.45
  angle deg
:documentation
  two bones
  bonedata is mentioned here, too
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name thigh
    direction 0 -1 0
    length 8
    axis 0 0 20 XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-60.0 70.0)
  end
  begin
    id 2
    name shin
    direction 0 -1 0
    length 7
    axis 0 30 0 XYZ
    dof rx
  end
  begin
    id 3
    name sole
    direction 0 0 2
    length 3
    axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root thigh
    thigh shin
    shin sole
  end
"""

AMC = """#!OML:ASF made-up.asf
:FULLY-SPECIFIED
:DEGREES
1
root 1 2 3 10 20 30
thigh 40 50 60
shin 70
2
root 1 2 4 10 20 31
shin 71
thigh 40 50 61
"""

BODY = (
    "lhipjoint root 1 -0.2 0 2, lfemur lhipjoint 0 -1 0 7.5, ltibia lfemur 0 -1 0 7.5, lfoot ltibia 0 -0.3 1 2, "
    "rhipjoint root -1 -0.2 0 2, rfemur rhipjoint 0 -1 0 7.5, rtibia rfemur 0 -1 0 7.5, rfoot rtibia 0 -0.3 1 2, "
    "lowerback root 0 1 0 2, upperback lowerback 0 1 0 2, thorax upperback 0 1 0 2, "
    "upperneck thorax 0 1 0 1.5, head upperneck 0 1 0 1.6, "
    "lclavicle thorax 1 0 0 3, lhumerus lclavicle 1 0 0 5, lradius lhumerus 1 0 0 4, lhand lradius 1 0 0 1, "
    "rclavicle thorax -1 0 0 3, rhumerus rclavicle -1 0 0 5, rradius rhumerus -1 0 0 4, rhand rradius -1 0 0 1"
)
"""Bones of a standing body: name, parent, direction and length."""


def body_asf(size: float, unit_length: float) -> bytes:
    """Return an ASF of a body with legs of 17 units times `size`, which states `length` as its unit of length."""
    bones = [bone.split() for bone in BODY.split(", ")]
    data = "".join(
        f"begin\n name {name}\n direction {x} {y} {z}\n length {float(length) * size}\n axis 0 0 0 XYZ\nend\n"
        for name, _, x, y, z, length in bones
    )
    tree = "".join(f"{parent} {name}\n" for name, parent, *_ in bones)
    units = f":version 1.10\n:units\n length {unit_length}\n angle deg\n"
    return f"{units}:bonedata\n{data}:hierarchy\nbegin\n{tree}end\n".encode()

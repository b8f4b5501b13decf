"""Compiles every kernel once, so that the first real file does not wait: `python -m marey_motion.warm_up`.

The compiled code is kept on disk; later processes load it in a fraction of a second.
"""

from __future__ import annotations

import numpy as np

_ASF = b""":version 1.10
:units
  mass 1.0
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name femur
    direction 0 -1 0
    length 7
    axis 0 0 0 XYZ
    dof rx
  end
:hierarchy
  begin
    root femur
  end
"""
_AMC = b":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 16 0 0 0 0\nfemur 10\n2\nroot 0 16 0 0 0 0\nfemur 11.5\n"


def compile_kernels() -> None:
    """Read, check, retarget, write and search a second of generated walking in every way that uses a kernel."""
    from marey_motion.formats import ImportOptions, read_motion, write_motion
    from marey_motion.gait import game_skeleton, generate_gait
    from marey_motion.kinematics import global_rotations
    from marey_motion.matching.search import build_index, find_best
    from marey_motion.retargeting import plan_retarget, retarget
    from marey_motion.rigs import guess_axes, map_joints

    read_motion(_AMC, "walk.amc", companion=_ASF, options=ImportOptions(unit_scale_m=0.05644, up_axis="y"))
    clip = generate_gait(1.3, 0.2, 1.0)
    read = read_motion(write_motion(clip, "bvh"), "walk.bvh").clip
    assert read is not None
    target = game_skeleton()
    rigs = []
    for skeleton in (read.skeleton, target):
        mapping = map_joints(skeleton)
        rigs.append((skeleton, mapping, guess_axes(skeleton, mapping)))
    result = retarget(read, plan_retarget(*rigs[0], *rigs[1]))
    global_rotations(result)
    poses = clip.poses[:, :27].astype(float)
    find_best(build_index(poses, np.array([0, len(poses)]), np.ones(len(poses), np.bool_)), poses[0], 1)


if __name__ == "__main__":
    compile_kernels()

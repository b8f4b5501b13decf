"""A rig without stated axes whose bones are all on one line at rest, so that only a motion shows its axes."""

from dataclasses import replace

import numpy as np

from marey_motion import kinematics, quaternions
from marey_motion.clip import Clip


def folded(clip: Clip, twisted_rad: float) -> Clip:
    """Return the motion on a rig whose bones point along +x of their parents at rest, with twisted forearms.

    Parameters
    ----------
    clip : Clip    F frames of a body whose rest pose stands
    twisted_rad : float    angle about the forearms by which their frames, and the hands, are turned in all frames
    """
    body = clip.skeleton
    frames = quaternions.identity(body.joint_count).astype(np.float64)
    for joint in range(body.joint_count):
        ends = [body.offsets[child] for child in body.children[joint]]
        if ends and np.linalg.norm(ends[0]) > 0.0:
            frames[joint] = quaternions.between_vectors(np.eye(3)[0], ends[0] / np.linalg.norm(ends[0]))
        elif joint:
            frames[joint] = frames[body.parents[joint]]
    above = quaternions.conjugate(frames[body.parents[1:]])
    offsets = body.offsets.copy()
    offsets[1:] = quaternions.rotate_vectors(above, offsets[1:])
    turns = [quaternions.conjugate(frames[site.joint]) for site in body.end_sites]
    sites = tuple(
        replace(site, offset=quaternions.rotate_vectors(turn, site.offset).astype(np.float64))
        for site, turn in zip(body.end_sites, turns, strict=True)
    )
    skeleton = replace(body, offsets=offsets, end_sites=sites)
    world = quaternions.multiply(kinematics.global_rotations(clip).astype(np.float64), frames)
    twist = quaternions.from_axis_angle(np.eye(3)[0], np.array(twisted_rad))
    for name in ("LeftForeArm", "RightForeArm", "LeftHand", "RightHand"):
        joint = body.index_of(name)
        world[:, joint] = quaternions.multiply(world[:, joint], twist)
    local = kinematics.as_local_rotations(skeleton, world)
    poses = np.concatenate((clip.root_translations, local.reshape(clip.frame_count, -1)), axis=1)
    return Clip(skeleton, clip.frame_rate_hz, poses.astype(np.float32))

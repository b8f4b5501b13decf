"""Reference computation of a matching database's rows in plain loops, to test the vectorised code."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation
from tests.support.present import present

from marey_motion.clip import Clip
from marey_motion.matching.body import MatchingBody


class PlainRows(NamedTuple):
    """Features (F, 27), root positions (F, 2) and headings (F,), pose points (F, P, 3), contacts (F, 2)."""

    features: np.ndarray
    positions: np.ndarray
    headings: np.ndarray
    points: np.ndarray
    contacts: np.ndarray


def joints_in_the_world(clip: Clip) -> np.ndarray:
    """Return joint positions (F, J, 3) in world coordinates, in metres, computed frame by frame from the root down."""
    skeleton = clip.skeleton
    places = np.zeros((clip.frame_count, skeleton.joint_count, 3))
    for frame in range(clip.frame_count):
        turned: list[Rotation] = []
        for joint, parent in enumerate(skeleton.parents):
            local = Rotation.from_quat(np.array(clip.rotations[frame, joint], float), scalar_first=True)
            if parent < 0:
                turned.append(local)
                places[frame, joint] = clip.root_translations[frame]
                continue
            offset = np.array(skeleton.offsets[joint])
            if joint in clip.translated_joints:
                offset = present(clip.translations)[frame, clip.translated_joints.index(joint)].astype(float)
            places[frame, joint] = places[frame, parent] + turned[parent].apply(offset)
            turned.append(turned[parent] * local)
    return places


def plain_rows(clip: Clip, body: MatchingBody) -> PlainRows:
    """Return the rows of a clip at 60 Hz that does not loop."""
    places = joints_in_the_world(clip)
    frames = len(places)
    ground = places[:, body.torso][:, [0, 2]]
    facing = np.zeros((frames, 2))
    for frame in range(frames):
        across = sum(
            places[frame, left] - places[frame, right] for left, right in zip(body.lefts, body.rights, strict=True)
        )
        forward = np.cross(across, [0.0, 1.0, 0.0])
        facing[frame] = forward[[0, 2]] / np.hypot(forward[0], forward[2])
    odd = frames if frames % 2 else frames - 1
    if odd >= 5:
        ground = np.asarray(savgol_filter(ground, min(31, odd), 3, axis=0), dtype=np.float64)
        facing = np.asarray(savgol_filter(facing, min(61, odd), 3, axis=0), dtype=np.float64)
    headings = np.unwrap(np.arctan2(facing[:, 0], facing[:, 1]))
    velocities = _velocities(places)
    into_root = [Rotation.from_euler("y", -heading) for heading in headings]
    rows, points = [], []
    for frame in range(frames):
        root = np.array([ground[frame, 0], 0.0, ground[frame, 1]])
        turn = into_root[frame]
        row = [turn.apply(places[frame, foot] - root) for foot in body.feet]
        row += [turn.apply(velocities[frame, joint]) for joint in (*body.feet, body.hips)]
        later = [min(frame + ticks, frames - 1) for ticks in (20, 40, 60)]
        ways = [ground[one] - ground[frame] for one in later]
        row += [turn.apply([x, 0.0, z])[[0, 2]] for x, z in ways]
        row += [turn.apply([np.sin(headings[one]), 0.0, np.cos(headings[one])])[[0, 2]] for one in later]
        rows.append(np.concatenate(row))
        points.append([turn.apply(places[frame, joint] - root) for joint in body.pose_joints])
    return PlainRows(np.array(rows), ground, headings, np.array(points), _contacts(velocities[:, list(body.toes)]))


def _velocities(places: np.ndarray) -> np.ndarray:
    frames = len(places)
    if frames == 1:
        return np.zeros_like(places)
    steps = [(places[frame + 1] - places[frame]) * 60.0 for frame in range(frames - 1)]
    if frames == 2:
        return np.array([steps[0], steps[0]])
    inner = [(places[frame + 1] - places[frame - 1]) * 30.0 for frame in range(1, frames - 1)]
    first = steps[0] + 0.5 * (steps[0] - steps[1])
    last = steps[-1] + 0.5 * (steps[-1] - steps[-2])
    return np.array([first, *inner, last])


def _contacts(velocities: np.ndarray) -> np.ndarray:
    slow = np.linalg.norm(velocities, axis=-1) < 0.15
    standing = np.zeros_like(slow)
    for frame in range(len(slow)):
        around = [min(max(frame + shift, 0), len(slow) - 1) for shift in range(-2, 3)]
        standing[frame] = slow[around].sum(axis=0) >= 3
    return standing

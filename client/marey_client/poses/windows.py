"""Windows of stored motions for training: a dataset as the DataLoader of PyTorch takes it, without PyTorch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from marey_client.arguments import checks_arguments
from marey_client.errors import BadArgument
from marey_client.poses.arrays import Joints
from marey_client.poses.handle import PosesHandle

Content = Literal["poses", "rotations", "positions", "velocities"]
SplitBy = Literal["subject", "take", "clip"]


class MotionWindow(NamedTuple):
    """Window of frames of a clip, which begins at the frame `first`."""

    clip: PosesHandle
    first: int


@checks_arguments
class MotionWindows:
    """Dataset of windows of equal length in clips, at the revisions of the handles; indexing reads one window.

    Clips that are shorter than a window contribute no window. The dataset can be sent to other processes, such as those
    of a DataLoader. A forked process opens connections of its own. Tokens are not pickled: a process that gets a
    pickled dataset looks up the token as the command line does.

    Parameters
    ----------
    clips : handles of clips of one frame rate, such as `lab.clips` or `lab.clips.where("raw", query="subject = 02")`;
        without `joints`, all with the same number of joints
    frames : number of frames of a window
    stride : number of frames from the start of one window to the start of the next; default: `frames`, so that windows
        do not overlap
    content : what a window contains. poses: root translation and local rotations, (frames, 3 + 4 * joints); rotations:
        local rotations, (frames, joints, 4); positions and velocities: in the world, (frames, joints, 3)
    joints : names of the joints, in their order; default: all joints of each clip
    seed : seed of a random order of the windows; default: None, in the order of the clips, then of time
    """

    @checks_arguments
    def __init__(
        self,
        clips: Iterable[PosesHandle],
        *,
        frames: int,
        stride: int | None = None,
        content: Content = "poses",
        joints: Joints = None,
        seed: int | None = None,
    ) -> None:
        stride = frames if stride is None else stride
        if frames < 1 or stride < 1:
            raise BadArgument(f"frames and stride must be at least 1, not {frames} and {stride}")
        if content not in get_args(Content):
            raise BadArgument(f"content: {content!r} is not valid; give one of {', '.join(get_args(Content))}")
        self.frames, self.content, self.joints, self.seed = frames, content, joints, seed
        clips = tuple(clips)
        _require_one("frame rate", {clip.path: clip.frame_rate_hz for clip in clips}, "choose clips of one frame rate")
        if joints is None:
            counts = {clip.path: clip.item.summary["joints"] for clip in clips}
            _require_one("number of joints", counts, "name the joints, or choose clips of one skeleton")
        self.windows = [
            MotionWindow(clip, first) for clip in clips for first in range(0, clip.frames - frames + 1, stride)
        ]
        if seed is not None:
            order = np.random.default_rng(seed).permutation(len(self.windows))
            self.windows = [self.windows[place] for place in order]

    def __repr__(self) -> str:
        return f"<{len(self)} windows of {self.frames} frames, {self.content}>"

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, place: int) -> dict[str, Any]:
        """Read one window: `motion` (an array as `content` says), the path `clip`, its `id`, and the `first` frame."""
        clip, first = self.windows[place]
        frames = slice(first, first + self.frames)
        motion: Any
        if self.content == "poses":
            motion = clip.motion(frames=frames, joints=self.joints, revision=clip.item.revision).poses
        else:
            motion = getattr(clip, self.content)(frames=frames, joints=self.joints)
        return {"motion": motion, "clip": clip.path, "id": clip.id, "first": first}

    def split(self, shares: Mapping[str, float], *, by: SplitBy = "subject", seed: int = 0) -> dict[str, MotionWindows]:
        """Divide the windows into parts, such as `{"train": 0.8, "test": 0.2}`, without splitting a group.

        The windows of one subject form a group; with `by="take"` or `by="clip"`, those of one take or clip. So
        `by="clip"` may put clips of the same subject or take into different parts. The groups are assigned in a random
        order with the seed `seed`, each to the part that lacks the most windows of its share; no part stays empty.
        Raises `BadArgument` if a clip lacks the subject or take of `by`, if there are fewer groups than parts, or if a
        share is not valid.
        """
        if not shares or not all(0 < share < float("inf") for share in shares.values()):
            raise BadArgument(f"shares: every part needs a share above 0, not {dict(shares)}")
        groups: dict[str, list[MotionWindow]] = {}
        for window in self.windows:
            groups.setdefault(_group_of(window.clip, by), []).append(window)
        if len(groups) < len(shares):
            raise BadArgument(
                f"by: the clips have {len(groups)} different values of {by}, fewer than the {len(shares)} parts; split "
                "into fewer parts, or by another field"
            )
        order = np.random.default_rng(seed).permutation(sorted(groups))
        wanted = {name: share / sum(shares.values()) * len(self.windows) for name, share in shares.items()}
        parts: dict[str, list[str]] = {name: [] for name in shares}
        left = len(order)
        for group in order:
            empty = [name for name, members in parts.items() if not members]
            neediest = max(empty if left <= len(empty) else parts, key=lambda name: wanted[name])
            parts[neediest].append(str(group))
            wanted[neediest] -= len(groups[str(group)])
            left -= 1
        return {
            name: self._of({window for one in members for window in groups[one]}) for name, members in parts.items()
        }

    def _of(self, chosen: set[MotionWindow]) -> MotionWindows:
        part = MotionWindows((), frames=self.frames, content=self.content, joints=self.joints, seed=self.seed)
        part.windows = [window for window in self.windows if window in chosen]  # in the order of this dataset
        return part


def _require_one(what: str, values: Mapping[str, float], remedy: str) -> None:
    """Raise `BadArgument` if the values, by path of the clip, are not all equal; `what` names the values."""
    examples = {value: path for path, value in reversed(list(values.items()))}
    if len(examples) > 1:
        listed = ", ".join(f"{value:g} in {path!r}" for value, path in sorted(examples.items())[:4])
        raise BadArgument(f"the clips have more than one {what}: {listed}; {remedy}")


def _group_of(clip: PosesHandle, by: SplitBy) -> str:
    if by == "clip":
        return clip.id
    group = clip.item.summary.get(by)
    if group is None:
        raise BadArgument(f"{clip.path!r} has no {by}; record it with `marey record`, or split by clip")
    return str(group)

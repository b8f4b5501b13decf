"""Compiled functions of `live_windows`, kept apart so that importing the rest of the package does not load numba.

`take` is a `live_windows.LiveTake`, whose arrays are changed in place; `filters` is a `live_windows.Filters`. Frames
are processed one by one, so that results do not depend on how the frames were divided into requests.
"""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled

RECEIVED, SMOOTHED = 0, 1
"""Indices in `take.counters`."""


@compiled
def _estimate(take, smoother, frame, column):
    """Smooth one column of `take.raw` at a frame, with the matrix `smoother` (see `live_windows.smoother`)."""
    width = smoother.shape[0]
    first = max(min(frame - width // 2, take.counters[RECEIVED] - width), 0)
    total = 0.0
    for place in range(width):
        total += smoother[frame - first, place] * take.raw[(first + place) % take.raw.shape[0], column]
    return total


@compiled
def _add_step(take, place, left, ahead, length):
    """Replace the oldest step in the ring buffer, which is at `place`, and update the sums of the steps.

    `left` and `ahead` are the parts of the step relative to the facing direction; `length` is its length.

    The sums are recomputed once per cycle of the buffer, so that rounding errors do not accumulate.
    """
    for column, value in enumerate((length, ahead, left)):
        take.sums[column] += value - take.steps[place, column]
        take.steps[place, column] = value
    if place == take.steps.shape[0] - 1:
        for column in range(3):
            total = 0.0
            for step in range(take.steps.shape[0]):
                total += take.steps[step, column]
            take.sums[column] = total


@compiled
def _move_to(take, x, z, heading):
    """Append a smoothed root to the ring buffers, together with the step that leads to it."""
    frame, span = take.counters[SMOOTHED], take.steps.shape[0]
    if frame > 0:
        heading += 2.0 * np.pi * np.round((take.root[2] - heading) / (2.0 * np.pi))
        facing = 0.5 * (heading + take.root[2])
        sine, cosine = np.sin(facing), np.cos(facing)
        step_x, step_z = x - take.root[0], z - take.root[1]
        ahead, left = step_x * sine + step_z * cosine, step_x * cosine - step_z * sine
        _add_step(take, (frame - 1) % span, left, ahead, np.hypot(step_x, step_z))
    take.root[0], take.root[1], take.root[2] = x, z, heading
    take.headings[frame % (span + 1)] = heading
    take.counters[SMOOTHED] = frame + 1


@compiled
def _smooth(take, filters, frame, shortest_mean):
    """Compute the smoothed position and heading of the root at a frame, and store them as the current ones.

    If the smoothed facing direction is shorter than `shortest_mean`, the direction of the frame itself is used.
    """
    x = _estimate(take, filters.positions, frame, 0)
    z = _estimate(take, filters.positions, frame, 1)
    facing_x = _estimate(take, filters.directions, frame, 2)
    facing_z = _estimate(take, filters.directions, frame, 3)
    if not np.hypot(facing_x, facing_z) > shortest_mean:
        place = frame % take.raw.shape[0]
        facing_x, facing_z = take.raw[place, 2], take.raw[place, 3]
    _move_to(take, x, z, np.arctan2(facing_x, facing_z))


@compiled
def newest_window(take, duration_s, window):
    """Write to `window` the speed, turn rate, forward and strafe velocity of the newest window of `take`.

    `duration_s` is the duration of a window, for whose steps the buffers of `take` have room. Returns whether the take
    is long enough.
    """
    frame, span = take.counters[SMOOTHED] - 1, take.steps.shape[0]
    if frame < span:
        return False
    window[0] = take.sums[0] / duration_s
    window[1] = (take.root[2] - take.headings[(frame + 1) % (span + 1)]) / duration_s
    window[2] = take.sums[1] / duration_s
    window[3] = take.sums[2] / duration_s
    return True


@compiled
def receive(take, filters, frames, duration_s, shortest_mean, windows):
    """Process raw frames (n, 4), with columns as in `LiveTake.raw`.

    The windows that the frames complete are written to `windows`; the number of these windows is returned. `duration_s`
    is the duration of a window, and `shortest_mean` as in `_smooth`.
    """
    width = take.raw.shape[0]
    written = 0
    for index in range(frames.shape[0]):
        received = take.counters[RECEIVED] + 1
        for column in range(4):
            take.raw[(received - 1) % width, column] = frames[index, column]
        take.counters[RECEIVED] = received
        if received < width:
            continue
        for frame in range(take.counters[SMOOTHED], received - width // 2):
            _smooth(take, filters, frame, shortest_mean)
            if newest_window(take, duration_s, windows[written]):
                written += 1
    return written


@compiled
def finish(take, filters, duration_s, shortest_mean, windows):
    """Smooth the last frames of a take; write the windows that these frames complete, and return the number of windows.

    The parameters are as in `receive`.
    """
    written = 0
    for frame in range(take.counters[SMOOTHED], take.counters[RECEIVED]):
        _smooth(take, filters, frame, shortest_mean)
        if newest_window(take, duration_s, windows[written]):
            written += 1
    return written

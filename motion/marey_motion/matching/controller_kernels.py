"""The compiled loop of motion matching, in a separate module so that importing other modules does not load numba.

Ground positions are (x, z) in metres; headings are in radians and increase in a left turn. Parameters with the same
name have the same meaning in all functions:

* `index` is a `search.SearchIndex`.
* `desired` is the desired path, a `controller.TrajectoryArrays`; `when` is a time on this path, in ticks.
* `rules` is a `controller.ControllerConstants`, and `playback` a `controller.DatabaseArrays`.
* `record` is a tuple of the arrays of a `TrialRecord`, which are filled.
"""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled
from marey_motion.matching.search_kernels import cost_of, nearest, nearest_weighted

# Ways to follow the desired path.
BY_TIME = 0
BY_PATH = 1
OPEN_LOOP = 2

# `record.Status`
KEPT = 0
REPLACING = 1
REPLACED = 2
FORCED = 3

# If the desired motion changes by more than this from one tick to the next, a search is made at once.
JUMP_M_S = 0.5
JUMP_RAD = np.pi / 6
# The nearest point of the path is searched for only within this time of the last one, so that no lap is skipped.
PATH_WINDOW_S = 0.5


@compiled
def _arc(speed, turn_rate, elapsed):
    """Compute the movement during `elapsed` seconds at constant speed and turn rate.

    Returns the distances to the left and forward, in the frame at the start, and the turn in radians.
    """
    half = 0.5 * turn_rate * elapsed
    chord = speed * elapsed * (np.sin(half) / half if half != 0.0 else 1.0)
    return chord * np.sin(half), chord * np.cos(half), 2.0 * half


@compiled
def _outward(heading, left, forward):
    """Convert a step of a root with `heading`, given as distances to the left and forward, to (x, z) in the world."""
    sine, cosine = np.sin(heading), np.cos(heading)
    return left * cosine + forward * sine, forward * cosine - left * sine


@compiled
def _desired_root(desired, when):
    """Compute x, z and heading of the desired path at `when` ticks.

    After its end, the path continues with its last speed and turn rate.
    """
    last = desired.headings.shape[0] - 1
    if when >= last:
        left, forward, turn = _arc(desired.speeds[last], desired.turn_rates[last], (when - last) * desired.tick_s)
        x, z = _outward(desired.headings[last], left, forward)
        return desired.positions[last, 0] + x, desired.positions[last, 1] + z, desired.headings[last] + turn
    tick = int(when)
    rest = when - tick
    x, z, heading = desired.positions[tick, 0], desired.positions[tick, 1], desired.headings[tick]
    x += rest * (desired.positions[tick + 1, 0] - x)
    z += rest * (desired.positions[tick + 1, 1] - z)
    return x, z, heading + rest * (desired.headings[tick + 1] - heading)


@compiled
def _progress(desired, when, x, z):
    """Find the time, in ticks, at which the desired path is nearest to (x, z).

    Only times near `when`, the result at the previous tick, are searched.
    """
    window = int(PATH_WINDOW_S / desired.tick_s)
    best, best_square = 0, np.inf
    for tick in range(max(0, int(when) - window), int(when) + window + 1):
        path_x, path_z, _ = _desired_root(desired, float(tick))
        square = (path_x - x) ** 2 + (path_z - z) ** 2
        if square < best_square:
            best, best_square = tick, square
    here_x, here_z, _ = _desired_root(desired, float(best))
    next_x, next_z, _ = _desired_root(desired, best + 1.0)
    step_x, step_z = next_x - here_x, next_z - here_z
    square = step_x * step_x + step_z * step_z
    if square == 0.0:
        return float(best)
    along = ((x - here_x) * step_x + (z - here_z) * step_z) / square
    return max(0.0, best + min(0.5, max(-0.5, along)))


@compiled
def _moment(rules, desired, when, tick, x, z):
    """Compute the time on the desired path, in ticks, that corresponds to `tick`.

    If the path is followed by position, the result is the time at which the path is nearest to (x, z); only times near
    `when`, the result at the previous tick, are searched. Otherwise, the result is `tick` itself.
    """
    return _progress(desired, when, x, z) if rules.follow == BY_PATH else float(tick)


@compiled
def moments_along(rules, desired, positions, out):
    """Fill `out` (T,) with the time on the desired path, in ticks, that corresponds to each tick of a trial.

    `positions` (T, 2) are the positions of the root at the ticks.
    """
    when = 0.0
    for tick in range(positions.shape[0]):
        if tick > 0:
            when = _moment(rules, desired, when, tick, positions[tick, 0], positions[tick, 1])
        out[tick] = when


@compiled
def fill_query(index, playback, rules, desired, row, when, x, z, heading, query):
    """Fill `query` (D,) with normalised features: the pose of the database's row `row`, then the desired trajectory.

    The trajectory starts at tick `when`, and is seen from the root at `x`, `z` in metres with `heading` in radians. In
    open loop, the trajectory is the arc with the desired speed and turn rate.
    """
    horizons = playback.horizons_s.shape[0]
    first = query.shape[0] - 4 * horizons
    query[:first] = index.rows[row, :first]
    now = min(int(when), desired.speeds.shape[0] - 1)
    sine, cosine = np.sin(heading), np.cos(heading)
    for h in range(horizons):
        if rules.follow == OPEN_LOOP:
            left, forward, turn = _arc(desired.speeds[now], desired.turn_rates[now], playback.horizons_s[h])
        else:
            path_x, path_z, path_heading = _desired_root(desired, when + playback.horizons_ticks[h])
            left = (path_x - x) * cosine - (path_z - z) * sine
            forward = (path_x - x) * sine + (path_z - z) * cosine
            turn = path_heading - heading
        position = first + 2 * h
        direction = position + 2 * horizons
        query[position], query[position + 1] = left, forward
        query[direction], query[direction + 1] = np.sin(turn), np.cos(turn)
    for d in range(first, query.shape[0]):
        query[d] = (query[d] - playback.offset[d]) / playback.scale[d]


@compiled
def _distance_cost(index, points, row, other, query, first, limit):
    """Compute the cost of row `other` as the successor of row `row`.

    The cost is the squared difference between the trajectory features of `other` and those of the query (from dimension
    `first` on), plus the distances, in metres, between the pose joints of `row` and `other`. If the cost exceeds
    `limit`, any value above `limit` is returned.
    """
    cost = 0.0
    for d in range(first, query.shape[0]):
        difference = index.rows[other, d] - query[d]
        cost += difference * difference
    for p in range(points.shape[1]):
        if cost > limit:
            return cost
        square = 0.0
        for c in range(3):
            difference = np.float64(points[other, p, c]) - np.float64(points[row, p, c])
            square += difference * difference
        cost += np.sqrt(square)
    return cost


@compiled
def _nearest_by_distance(index, points, row, query, first, skip_start, skip_stop):
    best_row, best_cost = -1, np.inf
    for other in range(index.rows.shape[0]):
        if index.selectable[other] and not skip_start <= other < skip_stop:
            cost = _distance_cost(index, points, row, other, query, first, best_cost)
            if cost < best_cost:
                best_row, best_cost = other, cost
    return best_row, best_cost


@compiled
def _search(index, playback, rules, row, query, skip_start, skip_stop):
    if rules.by_distance:
        first = query.shape[0] - 4 * playback.horizons_s.shape[0]
        return _nearest_by_distance(index, playback.points, row, query, first, skip_start, skip_stop)
    return nearest(index, query, row, skip_start, skip_stop)


@compiled
def choose(index, playback, rules, row, query):
    """Choose the row whose successor is displayed next: the displayed row `row`, or the result of a search.

    Returns the chosen row, its cost, and the cost of continuing from `row`, which is NaN at the end of a clip. The pose
    in `query` is the pose of `row`, so only the trajectory contributes to the cost of continuing.
    """
    skip_start = skip_stop = 0
    if rules.window > 0:
        clip = np.searchsorted(playback.starts, row, side="right") - 1
        skip_start = max(playback.starts[clip], row - rules.window)
        skip_stop = min(playback.starts[clip + 1], row + rules.window + 1)
    best, cost = _search(index, playback, rules, row, query, skip_start, skip_stop)
    if playback.successors[row] < 0:
        if best < 0:
            best, cost = _search(index, playback, rules, row, query, 0, 0)
        return best, cost, np.nan
    going_on = cost_of(index, row, query)
    if best >= 0 and cost < going_on + rules.bias - rules.margin:
        return best, cost, going_on
    return row, going_on, going_on


@compiled
def _first_row(index, playback, rules, desired, root, query):
    """Find the row with which a trial starts, and the cost of this row; only trajectories are compared, not poses.

    `root` is x, z and heading; `query` (D,) is overwritten.
    """
    fill_query(index, playback, rules, desired, 0, 0.0, root[0], root[1], root[2], query)
    weights = np.ones(query.shape[0])
    weights[: query.shape[0] - 4 * playback.horizons_s.shape[0]] = 0.0
    return nearest_weighted(index, query, weights, 0, 0)


@compiled
def _later_row(playback, row, ticks):
    """Find the row `ticks` after `row` or, if the clip ends earlier, the last row of the clip that has a successor."""
    for _ in range(ticks):
        if playback.successors[playback.successors[row]] < 0:
            break
        row = playback.successors[row]
    return row


@compiled
def _jumped(desired, before, when):
    """Return whether the desired velocity or direction jumped between the times `before` and `when`, in ticks."""
    last = desired.speeds.shape[0] - 1
    a, b = min(int(before), last), min(int(when), last)
    x = desired.speeds[b] * np.sin(desired.headings[b]) - desired.speeds[a] * np.sin(desired.headings[a])
    z = desired.speeds[b] * np.cos(desired.headings[b]) - desired.speeds[a] * np.cos(desired.headings[a])
    return x * x + z * z > JUMP_M_S * JUMP_M_S or abs(desired.headings[b] - desired.headings[a]) > JUMP_RAD


@compiled
def _advance(playback, rules, row, offsets, root):
    """Move `root` (x, z, heading) by one tick: by the step that follows `row`, and by an offset of the root's velocity.

    The offset is caused by switches to other rows, and decays. `offsets` (2, 3) contains the offset (metres per second
    to the left and forward, radians per second) and its change per second; both are advanced by one tick.
    """
    left = playback.steps[row, 0] + offsets[0, 0] * rules.tick_s
    forward = playback.steps[row, 1] + offsets[0, 1] * rules.tick_s
    x, z = _outward(root[2], left, forward)
    root[0] += x
    root[1] += z
    root[2] += playback.steps[row, 2] + offsets[0, 2] * rules.tick_s
    for c in range(3):
        offset, change = offsets[0, c], offsets[1, c]
        offsets[0, c] = rules.decay[0, 0] * offset + rules.decay[0, 1] * change
        offsets[1, c] = rules.decay[1, 0] * offset + rules.decay[1, 1] * change


@compiled
def _pull_to_path(rules, desired, when, root):
    """Pull `root` (x, z, heading) towards the place and heading of the desired path at the time `when`, in ticks.

    Afterwards, the distance of the root from this place is limited to `rules.clamp_m`, in metres.
    """
    x, z, heading = _desired_root(desired, when)
    turn = heading - root[2]
    root[0] += rules.pull * (x - root[0])
    root[1] += rules.pull * (z - root[1])
    root[2] += rules.pull * (turn - 2.0 * np.pi * np.round(turn / (2.0 * np.pi)))
    distance = np.hypot(root[0] - x, root[1] - z)
    if distance > rules.clamp_m:
        root[0] = x + (root[0] - x) * rules.clamp_m / distance
        root[1] = z + (root[1] - z) * rules.clamp_m / distance


@compiled
def run(index, playback, desired, rules, skipped, record):
    """Simulate one trial, and fill the arrays of `record` with its ticks.

    The trial starts `skipped` ticks after the row that the first search finds, or just before the end of its clip.
    """
    query = np.empty(index.rows.shape[1])
    offsets = np.zeros((2, 3))
    root = np.array([desired.positions[0, 0], desired.positions[0, 1], desired.headings[0]])
    row, first_cost = _first_row(index, playback, rules, desired, root, query)
    row = _later_row(playback, row, skipped)
    status = FORCED
    before = when = 0.0
    forced_at = -rules.period
    for tick in range(record.rows.shape[0]):
        record.rows[tick], record.status[tick] = row, status
        record.positions[tick, 0], record.positions[tick, 1], record.headings[tick] = root[0], root[1], root[2]
        record.match_cost[tick] = record.continuing_cost[tick] = np.nan

        ended = playback.successors[row] < 0
        due = ended or tick % rules.period == 0
        if not due and tick - forced_at >= rules.period and _jumped(desired, before, when):
            due, forced_at = True, tick
        chosen = row
        if tick == 0:
            record.match_cost[0] = first_cost
        elif due:
            fill_query(index, playback, rules, desired, row, when, root[0], root[1], root[2], query)
            chosen, record.match_cost[tick], record.continuing_cost[tick] = choose(index, playback, rules, row, query)
        following = playback.successors[chosen]
        status = FORCED if ended or following != chosen + 1 else KEPT
        if chosen != row:
            if not ended:
                status = REPLACING
                if record.status[tick] == KEPT:
                    record.status[tick] = REPLACED
            if rules.blends_root:
                for c in range(3):
                    offsets[0, c] += (playback.steps[row, c] - playback.steps[chosen, c]) / rules.tick_s
        _advance(playback, rules, chosen, offsets, root)
        row, before = following, when
        when = _moment(rules, desired, when, tick + 1, root[0], root[1])
        if rules.holds:
            _pull_to_path(rules, desired, when, root)
            # The next desired positions are relative to the place to which the character was moved.
            when = _moment(rules, desired, before, tick + 1, root[0], root[1])

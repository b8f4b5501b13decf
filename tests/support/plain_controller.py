"""Reference implementation of the runtime loop of motion matching in plain Python, written from its definition.

Ground positions are complex numbers z + i·x, so that a heading is a factor exp(i·theta).
"""

import cmath
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from marey_motion.evaluation.scenario import Reference
from marey_motion.matching.database import MatchingDatabase
from marey_schemas.options.matching import ControllerOptions


@dataclass
class PlainRun:
    """Record of the loop, tick by tick; `searches` are the ticks with a search for another row."""

    rows: list[int] = field(default_factory=list)
    positions: list[complex] = field(default_factory=list)
    headings: list[float] = field(default_factory=list)
    switches: list[int] = field(default_factory=list)
    forced: list[int] = field(default_factory=list)
    searches: list[int] = field(default_factory=list)


def run_plainly(database: MatchingDatabase, path: Reference, options: ControllerOptions, ticks: int) -> PlainRun:
    """Follow `path` for `ticks` ticks, with plain loops over all rows; return the record of the ticks.

    The mode of the controller is "time" or "open_loop".
    """
    normalised = (database.features - database.normaliser.offset) / database.normaliser.scale
    points = database.root_positions[:, 1] + 1j * database.root_positions[:, 0]
    angles = database.root_headings
    wish = path.positions[:, 1] + 1j * path.positions[:, 0]
    rate = database.options.rate_hz
    period = round(options.search_every_s * rate)
    window = round(options.reselect_window_s * rate)
    run = PlainRun()

    def clip_of(row: int) -> Any:
        return next(clip for clip in database.clips if clip.start <= row < clip.stop)

    def next_row(row: int) -> int | None:
        clip = clip_of(row)
        if row + 1 < clip.stop:
            return row + 1
        return clip.start if clip.loop and database.options.end_policy == "loop" else None

    def step(row: int) -> tuple[complex, float]:
        clip = clip_of(row)
        if row + 1 < clip.stop:
            return (points[row + 1] - points[row]) * cmath.exp(-1j * angles[row]), angles[row + 1] - angles[row]
        before = step(row - 1)
        if next_row(row) is None:
            return before
        first = step(clip.start)
        return (before[0] + first[0]) / 2, (before[1] + first[1]) / 2

    def query(row: int, tick: int, position: complex, heading: float) -> np.ndarray:
        horizons = [round(h * rate) for h in database.options.horizons_s]
        places, directions = [], []
        for horizon in horizons:
            if options.follow == "open_loop":
                seconds, v, omega = horizon / rate, path.speeds_m_s[tick], path.turn_rates_rad_s[tick]
                turn = omega * seconds
                local = v * seconds if turn == 0 else v / omega * (cmath.exp(1j * turn) - 1) / 1j
            else:
                local = (wish[tick + horizon] - position) * cmath.exp(-1j * heading)
                turn = path.headings[tick + horizon] - heading
            places += [local.imag, local.real]
            directions += [math.sin(turn), math.cos(turn)]
        raw = np.array(places + directions)
        pose = len(normalised[row]) - len(raw)
        scaled = (raw - database.normaliser.offset[pose:]) / database.normaliser.scale[pose:]
        return np.concatenate((normalised[row][:pose], scaled))

    def cheapest(wanted: np.ndarray, first_dimension: int, allowed: np.ndarray) -> tuple[int, float]:
        costs = ((normalised[:, first_dimension:] - wanted[first_dimension:]) ** 2).sum(axis=1)
        costs[~allowed] = np.inf
        return int(np.argmin(costs)), float(costs.min())

    position, heading = complex(wish[0]), float(path.headings[0])
    trajectory = normalised.shape[1] - 4 * len(database.options.horizons_s)
    row, _ = cheapest(query(0, 0, position, heading), trajectory, database.selectable)
    blended, blended_change = np.zeros(3), np.zeros(3)
    y = 2 * math.log(2) / options.half_life_s
    last_forced = -period
    for tick in range(ticks):
        run.rows.append(row)
        run.positions.append(position)
        run.headings.append(heading)
        ended = next_row(row) is None
        search = ended or (tick > 0 and tick % period == 0)
        if tick > 0 and not search and tick - last_forced >= period:
            now, then = (path.speeds_m_s[t] * cmath.exp(1j * path.headings[t]) for t in (tick, tick - 1))
            if abs(now - then) > 0.5 or abs(path.headings[tick] - path.headings[tick - 1]) > math.radians(30):
                search, last_forced = True, tick
        chosen = row
        if search:
            run.searches.append(tick)
            wanted = query(row, tick, position, heading)
            near = np.zeros(len(normalised), dtype=bool)
            if window:
                clip = clip_of(row)
                near[max(clip.start, row - window) : min(clip.stop, row + window + 1)] = True
            allowed = database.selectable & ~near
            best, cost = cheapest(wanted, 0, allowed if allowed.any() or not ended else database.selectable)
            going_on = float(((normalised[row] - wanted) ** 2).sum()) + options.continuing_bias
            if ended:
                chosen = best
                run.forced.append(tick)
            elif best != row and cost < going_on - options.switch_margin:
                chosen = best
                run.switches.append(tick)
        (move, turn), (old_move, old_turn) = step(chosen), step(row)
        if chosen != row and options.root_inertialisation:
            difference = old_move - move
            blended += np.array([difference.imag, difference.real, old_turn - turn]) * rate
        position += (move + complex(blended[1], blended[0]) / rate) * cmath.exp(1j * heading)
        heading += turn + blended[2] / rate
        change = blended_change + y * blended
        decay = math.exp(-y / rate)
        blended, blended_change = decay * (blended + change / rate), decay * (blended_change - y * change / rate)
        following = next_row(chosen)
        assert following is not None
        row = following
    return run

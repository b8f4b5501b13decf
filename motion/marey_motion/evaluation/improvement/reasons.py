"""Descriptions of suggestions in sentences, for the person who owns the clips."""

from __future__ import annotations

from marey_motion.evaluation.improvement.duplicates import NearDuplicate
from marey_motion.evaluation.improvement.filling import Addition, FilledCell, Filling
from marey_motion.evaluation.improvement.redundancy import Removal
from marey_motion.evaluation.improvement.unused import UnusedClip, UnusedRange

NOTICEABLE_M = 0.0005
"""Smallest change of the mean distance from the path, in metres, that is given as a number."""


def why_unused_clip(clip: UnusedClip) -> str:
    """Explain why a clip can be removed.

    Parameters
    ----------
    clip : UnusedClip    the clip

    Returns
    -------
    str    a sentence
    """
    return f"No trial uses “{clip.name}”: without this clip ({clip.seconds:.1f} s), all trials stay exactly the same."


def why_unused_range(part: UnusedRange) -> str:
    """Explain why a range of a clip can be removed.

    The sentence states no exact effect: after a cut, the clip is filtered again, which changes frames near the cut.

    Parameters
    ----------
    part : UnusedRange    the range

    Returns
    -------
    str    a sentence
    """
    return (
        f"No trial uses “{part.name}” from {part.start_s:.2f} s to {part.stop_s:.2f} s: "
        f"without these {part.seconds:.1f} s, all trials stay nearly the same."
    )


def why_redundant(removal: Removal, trials: int) -> str:
    """Explain the effect of leaving a clip out.

    Parameters
    ----------
    removal : Removal    the clip and its effect
    trials : int    number of trials of the suite

    Returns
    -------
    str    a sentence
    """
    change = removal.changes["offset_mean"]
    if abs(change) < NOTICEABLE_M:
        effect = f"the mean distance from the path changes by less than {1000 * NOTICEABLE_M:g} mm"
    else:
        direction = "increases" if change > 0 else "decreases"
        effect = f"the mean distance from the path {direction} by {100 * abs(change):.1f} cm"
    if removal.replaced_share is not None:
        effect += f"; {100 * removal.replaced_share:.0f} % of its poses look like poses of clips that remain"
    return f"Without “{removal.name}” ({removal.seconds:.1f} s, used in {removal.trials} of {trials} trials), {effect}."


def why_duplicate(source: str, pair: NearDuplicate, most_perceived: float | None = None) -> str:
    """Explain why one clip of a pair is enough.

    Parameters
    ----------
    source : str    uid of the clip to remove
    pair : NearDuplicate    the pair
    most_perceived : float, optional    greatest perceptual distance of motions that look the same, if a metric was used

    Returns
    -------
    str    a sentence
    """
    gone, stays = (pair.first_name, pair.second_name) if source == pair.first else (pair.second_name, pair.first_name)
    if pair.same_content:
        return f"“{gone}” has the same content as “{stays}”: one of them is enough."
    alike = "nearly the mirror image of the motion of" if pair.mirrored else "nearly the same motion as"
    distances = f"mean distance {pair.distance_cm:.1f} cm"
    if pair.perceived is not None and most_perceived is not None:
        distances += f"; perceptual distance {pair.perceived:.2f}, up to {most_perceived:.2f} looks the same"
    return f"“{gone}” shows {alike} “{stays}” ({distances}): one of them may be enough."


def why_filling(filling: Filling) -> str:
    """Explain the gain of a clip from another collection.

    Parameters
    ----------
    filling : Filling    the clip

    Returns
    -------
    str    a sentence
    """
    gain = f"“{filling.name}” from {filling.collection} contains {filling.filled_s:.1f} s of the missing data"
    where = f"most of it at {_cell_in_words(filling.cells[0])}"
    if filling.needs_retarget:
        return f"{gain}, {where}; it has another skeleton and must be retargeted first."
    return f"{gain}, {where}; {100 * (filling.blendable_share or 0.0):.0f} % of it can be blended with the set."


def why_addition(addition: Addition) -> str:
    """Explain the gain of a clip in addition to the clips added before it.

    Parameters
    ----------
    addition : Addition    the clip

    Returns
    -------
    str    a sentence
    """
    return (
        f"“{addition.filling.name}” from {addition.filling.collection} then adds {addition.filled_s:.1f} s of the "
        f"data that is still missing; {100 * addition.coverage_index:.0f} % of the grid are covered then."
    )


def _cell_in_words(cell: FilledCell) -> str:
    if cell.turn_rate_deg_s == 0.0:
        return f"{cell.speed_m_s:g} m/s straight ahead"
    side = "left" if cell.turn_rate_deg_s > 0.0 else "right"
    return f"{cell.speed_m_s:g} m/s turning {side} at {abs(cell.turn_rate_deg_s):g}°/s"

"""Descriptions of suggestions in sentences, for the person who owns the clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from marey_motion.evaluation.compare import MetricChange
from marey_motion.evaluation.improvement.defects import Defects, Excess
from marey_motion.evaluation.improvement.duplicates import NearDuplicate
from marey_motion.evaluation.improvement.effects import Effect
from marey_motion.evaluation.improvement.filling import Addition, FilledCell, Filling
from marey_motion.evaluation.improvement.redundancy import Removal
from marey_motion.evaluation.improvement.repeating import PERCENT, RepeatedChange
from marey_motion.evaluation.improvement.unused import UnusedClip, UnusedRange
from marey_schemas.documents.quality import MEASURES
from marey_schemas.wording import counted, listed


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


def why_unused_again(effect: Effect) -> str:
    """Say how the mean distance from the path changes if all unused data is removed.

    Parameters
    ----------
    effect : Effect    the change, measured in replicates that are not part of the evaluation

    Returns
    -------
    str    a sentence
    """
    return f"Without all of this unused data, in other replicates, {distance_in_words(effect)}."


def why_redundant(removal: Removal, trials: int, confirmed: Effect | None = None) -> str:
    """Explain the effect of leaving a clip out.

    Parameters
    ----------
    removal : Removal    the clip and its estimated effect
    trials : int    number of trials of the suite
    confirmed : Effect, optional    the effect in replicates that were not used to choose the removal

    Returns
    -------
    str    a sentence
    """
    effect = _estimate_in_words(removal.estimate) if confirmed is None else distance_in_words(confirmed)
    if removal.replaced_share is not None:
        effect += f"; {100 * removal.replaced_share:.0f} % of its poses look like poses of clips that remain"
    return f"Without “{removal.name}” ({removal.seconds:.1f} s, used in {removal.trials} of {trials} trials), {effect}."


def _estimate_in_words(effect: Effect) -> str:
    """Describe an estimated effect that was not confirmed in other replicates."""
    change = effect.headlines["offset_mean"]
    return (
        f"the mean distance from the path seems to change by {100 * change.change:+.2f} cm{_interval(change)}, which "
        "was not confirmed in other replicates"
    )


def distance_in_words(effect: Effect) -> str:
    """Describe a confirmed effect on the mean distance from the path.

    Parameters
    ----------
    effect : Effect    the effect in replicates that were not used to choose the change

    Returns
    -------
    str    a part of a sentence
    """
    change = effect.headlines["offset_mean"]
    if change.verdict == "same":
        return f"the mean distance from the path stays the same{_interval(change)}"
    if change.verdict == "unclear":
        return f"no effect on the mean distance from the path was found{_interval(change)}"
    direction = "increases" if change.change > 0.0 else "decreases"
    return f"the mean distance from the path {direction} by {100 * abs(change.change):.2f} cm{_interval(change)}"


def _interval(change: MetricChange) -> str:
    """State in which interval the change lies if the same measurement is made again with another seed."""
    if not isinstance(change, RepeatedChange) or change.again_low is None or change.again_high is None:
        return ""
    low, high = 100 * change.again_low, 100 * change.again_high
    few = "" if change.again_percent == PERCENT else " or more, because few runs changed"
    return f" (another such measurement: {low:+.2f} to {high:+.2f} cm, in {change.again_percent} of 100 cases{few})"


def why_duplicate(source: str, pair: NearDuplicate, most_perceived: float | None = None) -> str:
    """Explain why one clip of a pair is enough.

    Parameters
    ----------
    source : str    uid of the clip to remove
    pair : NearDuplicate    the pair
    most_perceived : float, optional    perceptual distance up to which motions look the same; None without a metric

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


def why_filling(filling: Filling, defects: Defects | None = None) -> str:
    """Explain the gain of a clip from another collection, and name its defects that are far greater than in the set.

    Parameters
    ----------
    filling : Filling    the clip
    defects : Defects, optional    its defects beside those of the set, if they were compared

    Returns
    -------
    str    one sentence, or two if there are such defects, or if the clip could not be measured
    """
    gain, more = _gain_in_words(filling), "" if defects is None else _defects_in_words(defects)
    return f"{gain} {more}" if more else gain


def _gain_in_words(filling: Filling) -> str:
    gain = f"“{filling.name}” from {filling.collection} contains {filling.filled_s:.1f} s of the missing data"
    where = f"the largest part at {_cell_in_words(filling.cells[0])}"
    if filling.needs_retarget:
        return f"{gain}, {where}; it has another skeleton and must be retargeted first."
    return f"{gain}, {where}; {100 * (filling.blendable_share or 0.0):.0f} % of it can be blended with the set."


def why_addition(addition: Addition, defects: Defects | None = None) -> str:
    """Explain the gain of a clip in addition to the clips added before it.

    Parameters
    ----------
    addition : Addition    the clip
    defects : Defects, optional    its defects beside those of the set, if they were compared

    Returns
    -------
    str    one sentence, or up to three
    """
    gain = (
        f"“{addition.filling.name}” from {addition.filling.collection} then adds {addition.filled_s:.1f} s of the "
        f"data that is still missing; {100 * addition.coverage_index:.0f} % of the grid is covered then"
    )
    if addition.confirmed is None:
        said = f"{gain}. Its effect on the trials was not simulated."
    else:
        said = f"{gain}, and {distance_in_words(addition.confirmed)}."
    return f"{said} Look at it first, because of its defects." if defects is not None and defects.excesses else said


def _cell_in_words(cell: FilledCell) -> str:
    if cell.turn_rate_deg_s == 0.0:
        return f"{cell.speed_m_s:g} m/s straight ahead"
    side = "left" if cell.turn_rate_deg_s > 0.0 else "right"
    return f"{cell.speed_m_s:g} m/s turning {side} at {abs(cell.turn_rate_deg_s):g}°/s"


def why_look(fillings: Sequence[Filling], defects: Mapping[str, Defects]) -> str:
    """Name the clips that would fill gaps and have defects that are far greater than in the set.

    Parameters
    ----------
    fillings : sequence of Filling    the clips that would fill gaps
    defects : mapping of str to Defects    their defects by uid; empty if they were not compared

    Returns
    -------
    str    a sentence; empty if `defects` is empty
    """
    measured = [one for one in fillings if one.source in defects and defects[one.source].problem is None]
    if not measured:
        return (
            "None of them could be measured, so their quality was not compared with that of the set." if defects else ""
        )
    compared = defects[measured[0].source].compared
    if not compared:
        return "No clip of the set could be measured, so their quality was not compared with that of the set."
    worse = [f"“{one.name}”" for one in measured if defects[one.source].excesses]
    found = "none of them has defects that are far greater"
    if worse:
        found = (
            f"look at {listed(worse)} before you add {'them' if worse[1:] else 'it'}, because of far greater defects"
        )
    return (
        f"The quality of {counted(len(measured), 'clip')} was compared with that of the set "
        f"({counted(compared, 'clip')}): {found}."
    )


def _defects_in_words(defects: Defects) -> str:
    """Name the defects that are far greater than in the set; empty if there are none."""
    if defects.problem is not None:
        return f"Its quality was not measured: {defects.problem}."
    if not defects.excesses:
        return ""
    return f"Look at it before you add it: {'; '.join(map(_excess_in_words, defects.excesses))}."


def _excess_in_words(excess: Excess) -> str:
    measure = MEASURES[excess.measure]
    value, greatest = (f"{one:,.{measure.digits}f}" for one in (excess.value, excess.greatest))
    return f"{measure.title}: {value} {measure.unit}, in the set up to {greatest}"

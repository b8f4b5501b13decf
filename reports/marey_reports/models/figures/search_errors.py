"""Figure of the errors of searches for motions of a model that bring a joint to a given target position."""

from __future__ import annotations

from typing import Any

import numpy as np

from marey_motion.arrays import Floats
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import COLOURS, REFERENCE, Place, add_keys, add_panel, new_figure, tick_whole_numbers
from marey_reports.models.figures.subjects import ModelSubject
from marey_schemas.wording import counted

BINS = 30


def draw_search_check(subject: ModelSubject) -> Sketch | None:
    """Draw the errors of searches whose targets are positions of hands and feet in examples.

    Returns None if the accuracy of searches was not measured for this model.
    """
    check = subject.check
    if check is None:
        return None
    examples = counted(len(set(check.examples)), "example")
    about = f"positions of hands and feet of {examples}, for models trained without their takes"
    others = np.array([one == "subject" for one in check.left_out])
    if others.any():
        medians = [np.median(check.refined_cm[chosen]) for chosen in (~others, others)]
        about += (
            f" or without their performers; after refinement, the median is {medians[0]:.2f} cm for unseen takes and "
            f"{medians[1]:.2f} cm for unseen performers"
        )
    sketch = draw_search_errors(check.searched_cm, check.refined_cm, about=about)
    whose = {
        "left_out": check.left_out,
        "example": check.examples,
        "joint": check.joints,
        "canonical_frame": check.frames,
    }
    return sketch._replace(tables={"errors": {**whose, **sketch.tables["errors"]}})


def draw_search_errors(searched_cm: Floats, refined_cm: Floats, *, about: str = "") -> Sketch:
    """Draw the errors at n targets, after the search in the sample tree and after refinement of the found samples.

    Parameters
    ----------
    searched_cm, refined_cm : (n,) distance of a joint from its target in centimetres, before and after refinement
    about : description of the targets for the caption, without a full stop
    """
    ceiling = 1.02 * max(float(np.max(searched_cm, initial=0.0)), float(np.max(refined_cm, initial=0.0)), 0.1)
    edges = np.linspace(0.0, ceiling, BINS + 1)
    figure = new_figure(8.2, 3.0)
    panel = add_panel(figure, Place(0.75, 0.65, 5.2, 1.95), x="distance from the target (cm)", y="targets")
    drawn: tuple[tuple[str, Floats, str, dict[str, Any]], ...] = (
        ("after the search", searched_cm, REFERENCE, {"histtype": "stepfilled", "alpha": 0.55}),
        ("after refinement", refined_cm, COLOURS[0], {"histtype": "step", "lw": 1.6}),
    )
    for label, values, colour, look in drawn:
        panel.hist(values, edges.tolist(), color=colour, label=label, **look)
    panel.set_xlim(0.0, ceiling)
    tick_whole_numbers(panel.yaxis)
    add_keys(panel, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    table = {"target": np.arange(len(searched_cm)), "searched_cm": searched_cm, "refined_cm": refined_cm}
    return Sketch(figure, {"errors": table}, _caption(searched_cm, refined_cm, about))


def _caption(searched_cm: Floats, refined_cm: Floats, about: str) -> str:
    if not len(searched_cm):
        return "No target was searched for."
    found = [f"{np.median(values):.1f} cm (worst {values.max():.1f} cm)" for values in (searched_cm, refined_cm)]
    return (
        f"Distance from {counted(len(searched_cm), 'target')}{f' ({about})' if about else ''}: the median is "
        f"{found[0]} after the search of the tree, and {found[1]} after refinement."
    )

"""Definitions of the words and numbers in a model's report."""

from __future__ import annotations

from marey_motion.modelling.training_report import OUTLIER_DEVIATIONS
from marey_reports.drawing.markup import Html, element, joined
from marey_reports.drawing.tables import table

_WORDS = (
    ("example", "a clip that the model was made of, after it was aligned with the others"),
    ("sample", "a synthetic motion, drawn from the model"),
    (
        "canonical frame and time",
        "the common place and time of all examples: the root begins where the axes cross, the body faces forward, and "
        "the same moment of the action is at the same percentage of canonical time",
    ),
    ("reference", "the example whose time is the canonical time"),
    ("keyframe", "a moment of the action that was labelled in every example"),
    ("component", "a way in which the examples differ, found so that the first few hold most of their variance"),
    ("sd", "standard deviation: two of three examples lie within one of the mean, 19 of 20 within two"),
    ("latent space", "the numbers, one for each component, from which the model makes a motion"),
    ("mixture", "the normal distributions of these numbers in the examples, from which samples are drawn"),
)

_NUMBERS = (
    (
        "unseen error",
        "cm",
        "each example in turn is left out, and rebuilt from the mean and the components of all others: mean distance "
        "of its joints from where they were",
    ),
    (
        "log-likelihood",
        "",
        "natural logarithm of the density of an example's numbers; more is likelier. By a mixture that was fitted "
        "without the example, where that was measured",
    ),
    (
        "odd",
        "",
        f"its log-likelihood is more than {OUTLIER_DEVIATIONS:g} robust standard deviations (1.4826 times the median "
        "distance from the median) below that of the middle example",
    ),
    (
        "alignment",
        "cm",
        "root mean square distance of the joints of an example and of the reference, after the best turn and shift, "
        "along the path of the alignment",
    ),
    (
        "sliding feet",
        "cm/s",
        "mean speed over the ground of what touches it, in the steps of canonical time in which most examples stand "
        "still",
    ),
    ("BIC, AIC", "", "criteria that weigh how well a mixture fits against how many numbers it needs; less is better"),
)


def definitions() -> Html:
    """Write the definitions of terms and numbers, and the references of the method."""
    return joined(
        (
            table("Words", ("word", "meaning"), _WORDS, numbers=(), sortable=False),
            element("h3", "Numbers"),
            table("What the numbers mean", ("name", "unit", "meaning"), _NUMBERS, numbers=(), sortable=False),
            element(
                "p",
                "The method is that of Min and Chai, Motion Graphs++ (ACM Transactions on Graphics 31, 2012), in the "
                "form of Herrmann et al., Motion Data and Model Management for Applied Statistical Motion Synthesis "
                "(2019).",
            ),
        )
    )

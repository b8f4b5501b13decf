"""Definitions of the words and numbers in a model's report."""

from __future__ import annotations

from marey_motion.modelling.training_report import OUTLIER_DEVIATIONS
from marey_reports.drawing.markup import Html, element, joined
from marey_reports.drawing.tables import table

_WORDS = (
    ("example", "a clip on which the model was trained, after its alignment with the others"),
    ("sample", "a synthetic motion, drawn from the model"),
    (
        "canonical frame and time",
        "the common place and time of all examples: the root begins at the origin, the body faces forward, and the "
        "same moment of the action is at the same percentage of canonical time",
    ),
    ("reference", "the example whose time is the canonical time"),
    ("keyframe", "a moment of the action that was labelled in every example"),
    (
        "component",
        "principal component: a way in which the examples differ; the first few explain most of their variance",
    ),
    ("sd", "standard deviation; in a normal distribution, 68 % are within one of the mean, and 95 % within two"),
    ("latent space", "the space of the numbers, one for each component, from which the model generates a motion"),
    (
        "mixture",
        "the weighted normal distributions, fitted to these numbers of the examples, from which samples are drawn",
    ),
)

_NUMBERS = (
    (
        "left-out error",
        "cm",
        "mean distance of the joints of an example from their positions after a reconstruction from the mean and the "
        "components of the examples of all other takes",
    ),
    (
        "log-likelihood",
        "",
        "natural logarithm of the probability density of an example in latent space; higher is likelier. The mixture "
        "was fitted without the example, if this was computed",
    ),
    (
        "unusual",
        "",
        f"an example whose log-likelihood is more than {OUTLIER_DEVIATIONS:g} robust standard deviations (1.4826 "
        "times the median distance from the median) below the median of all examples",
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
        "mean speed over the ground of the feet that touch it, at the canonical frames at which most examples have "
        "them planted",
    ),
    (
        "BIC, AIC",
        "",
        "information criteria, which weigh the fit of a mixture against its number of parameters; lower is better",
    ),
)


def definitions() -> Html:
    """Write the definitions of terms and numbers, and the references of the method."""
    return joined(
        (
            table("Terms", ("term", "meaning"), _WORDS, numbers=(), sortable=False),
            element("h3", "Numbers"),
            table("Definitions of the numbers", ("name", "unit", "meaning"), _NUMBERS, numbers=(), sortable=False),
            element(
                "p",
                "The method is that of Min and Chai, Motion Graphs++ (ACM Transactions on Graphics 31, 2012), in the "
                "form of Herrmann et al., Motion Data and Model Management for Applied Statistical Motion Synthesis "
                "(2019).",
            ),
        )
    )

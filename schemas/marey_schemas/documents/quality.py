"""Quality of motion: the measures with their sources, and the document that a job of the kind `quality` writes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.documents.worst_first import worst_first
from marey_schemas.options.quality import QualityOptions

QUALITY_CODE = "quality@1"
"""Version of the computation; it changes whenever the same clip and options may give other numbers."""
CONTACT_LABELS: Mapping[str, tuple[bool, bool]] = MappingProxyType(
    {"contact_left": (True, False), "contact_right": (False, True), "contact_both": (True, True)}
)
"""Labels of segments in which the left and the right foot are in contact with the floor."""
LEAST_TAKES = 3
"""Least number of takes with which a total has a confidence interval."""
SPEED_EDGES_M_S = tuple(0.25 * step for step in range(33))
TURN_EDGES_DEG_S = tuple(-180.0 + 15.0 * step for step in range(25))
"""Edges of the bins in which windows of one second are counted; windows beyond the ends count in the outermost bins."""

_Finite = Annotated[float, Field(allow_inf_nan=False)]


class Measure(NamedTuple):
    """Measure of the quality of a clip, such as its foot skate.

    `better` says which values are better: "less", "more", or "neither" for facts that are no defects. `digits` is the
    number of decimals to show, and `misleads` says how a value can mislead its reader.
    """

    title: str
    unit: str
    better: Literal["less", "more", "neither"]
    digits: int
    meaning: str
    source: str
    misleads: str


_KIMODO = "Kimodo benchmark (NVIDIA, 2026)"
_TOES = "Without toe joints, the ankles are measured, which are higher and faster."
MEASURES: Mapping[str, Measure] = MappingProxyType(
    {
        "skate_weighted_m_s": Measure(
            "foot skate, weighted by height", "m/s", "less", 3,
            "Mean over frames and both toes of v (2 - 2^(h/H)): horizontal speed v, weighted by 1 on the floor and by "
            "0 at the height H and above.",
            "Zhang, Starke, Komura and Saito (2018), Mode-adaptive neural networks, H = 2.5 cm",
            "Frames in which a foot is in the air count with 0, so running skates less than walking.",
        ),
        "skate_height_m_s": Measure(
            "foot skate by height", "m/s", "less", 3,
            "Mean speed in space of the toes in the frames in which they are near the floor.",
            f"{_KIMODO}, FootSkateFromHeight, 5 cm",
            "A swinging foot that passes low over the floor counts as skating, also in recordings. Compare with the "
            "reference, not with 0.",
        ),
        "skate_contact_m_s": Measure(
            "foot skate by contact", "m/s", "less", 3,
            "Mean speed in space of ankles and toes while they are labelled as in contact.",
            f"{_KIMODO}, FootSkateFromContacts",
            "The labels decide. Labels that Marey detects are found by speed, so a foot that glides faster than a "
            "stance is not labelled and does not count.",
        ),
        "skate_ratio": Measure(
            "skate ratio", "", "less", 3,
            "Share of the steps from frame to frame, with a toe near the floor in both, in which this toe is faster "
            "than the limit, 0 to 1.",
            f"{_KIMODO}, FootSkateRatio, after Karunratanakul et al. (2023), Guided motion diffusion",
            "A foot that glides just below the limit has the ratio 0.",
        ),
        "near_floor_share": Measure(
            "toes near the floor", "", "neither", 3,
            "Share of the frames of both toes in which they are near the floor, 0 to 1.",
            "Denominator of foot skate by height and of the skate ratio",
            "If it is small, both depend on few frames.",
        ),
        "contact_consistency": Measure(
            "contact consistency", "", "more", 3,
            "Share of the frames of ankles and toes in which the labelled contact agrees with the contact by height "
            "and speed, 0 to 1.",
            f"{_KIMODO}, FootContactConsistency, 10 cm and 0.15 m/s",
            "Two wrong detections can agree. Rolling of the foot lowers it in recordings, too.",
        ),
        "penetration_m": Measure(
            "penetration", "m", "less", 4,
            "Mean over frames of the depth of the lowest joint or end of a bone below height 0.",
            "Yuan et al. (2023), PhysDiff, with joints instead of the vertices of a mesh",
            "The skin is lower than the joints: a foot can be in the floor without penetration. An import that puts "
            "the floor wrong shows as penetration.",
        ),
        "penetration_max_m": Measure(
            "greatest penetration", "m", "less", 4,
            "Greatest depth of a joint or end of a bone below height 0 in any frame of the clip.",
            "Greatest value of penetration",
            "One frame decides, such as the pose before a recording begins.",
        ),
        "jitter_m_s3": Measure(
            "jitter", "m/s³", "less", 1,
            "Mean over frames and joints of the jerk, the third derivative of the position.",
            "Yi, Zhou and Xu (2021), TransPose, which prints it in 100 m/s³",
            "It grows with the frame rate and with the speed of the motion; smoothing lowers it, and hides contacts.",
        ),
        "jerk_peak_m_s3": Measure(
            "greatest jerk", "m/s³", "less", 0,
            "Greatest jerk of a joint in any measured frame.",
            "Greatest value of the jerk in jitter",
            "One frame decides. It finds hard landings, too, and misses pops in frames that resampling leaves out.",
        ),
        "limit_excess_deg": Measure(
            "excess of joint limits", "°", "less", 2,
            "Mean over frames of the greatest angle by which a knee or an elbow exceeds its range.",
            "Ranges of the American Academy of Orthopaedic Surgeons (1965): knee -10° to 135°, elbow to 150°",
            "Only the two hinges that can be measured on any skeleton are judged. Kneeling people exceed 135°.",
        ),
        "limit_excess_max_deg": Measure(
            "greatest excess of joint limits", "°", "less", 1,
            "Greatest angle by which a knee or an elbow exceeds its range in any frame of the clip.",
            "Greatest value of excess of joint limits",
            "One frame decides.",
        ),
        "speed_m_s": Measure(
            "speed", "m/s", "neither", 2,
            "Mean speed of the root on the ground, in windows of one second.",
            "Abichequer Sangalli et al. (2022), coverage",
            "It says what the motion does, not how well.",
        ),
        "turn_rate_deg_s": Measure(
            "turn rate", "°/s", "neither", 1,
            "Mean absolute turn rate, in windows of one second.",
            "Abichequer Sangalli et al. (2022), coverage",
            "It says what the motion does, not how well.",
        ),
    }
)  # fmt: skip
"""Measures by name; a name ends with its unit, if it has one. Each is also a facet (published number) of clips."""
MAIN_MEASURE = "skate_weighted_m_s"
"""Measure by which clips are sorted: the measure of foot skate that has a value for every clip."""
QUALITY_FACETS: Mapping[str, str] = MappingProxyType(
    {name: f"{measure.meaning} By the newest job of the kind `quality`." for name, measure in MEASURES.items()}
)
"""Meaning of each facet that a job of the kind `quality` gives to clips, by name of the facet."""


class QualityConditions(Request):
    """Conditions that must be equal so that numbers of two results can be compared."""

    code: str = Field(QUALITY_CODE, max_length=64, description="Version of the computation.")
    options: QualityOptions
    contacts: Literal["detected", "annotated"] = Field(
        "detected", description="Origin of the contact labels: detected by speed, or annotations of the clips."
    )
    grouping: Literal["take"] = Field(
        "take",
        description="Unit that bootstrap samples for the intervals draw. take: the clips of a take together; a "
        "clip without a recorded take counts as a separate take.",
    )
    draws: int = Field(ge=0, description="Number of bootstrap samples for the intervals.")
    seed: int = Field(ge=0, description="Seed of the bootstrap samples.")


class QualityRow(Request):
    """Row of the table of clips: a clip with the values of its measures."""

    item: str
    revision: int
    name: str = Field(description="Path of the clip.")
    take: str = Field(
        description="Take of the clip. Clips of the same take are drawn together when intervals are computed."
    )
    seconds: _Finite
    frames: int = Field(description="Number of measured frames.")
    frame_rate_hz: _Finite = Field(description="Frame rate of the clip before it was resampled.")
    values: dict[str, _Finite | None] = Field(
        description="Value of each measure; null if it is undefined, for example if no toe is ever near the floor."
    )
    notes: tuple[str, ...] = ()


class QualityTotal(Request):
    """Mean of a measure over clips, weighted by their duration; clips in which it is undefined are left out."""

    value: _Finite | None
    low: _Finite | None = Field(
        description="Lower end of the 95 % confidence interval of the mean; null with fewer than 3 takes, or without "
        "bootstrap samples."
    )
    high: _Finite | None
    clips: int
    takes: int
    seconds: _Finite


class MeasuredSet(Request):
    """Measured clips with totals, and seconds of motion by speed and by turn rate."""

    clips: tuple[QualityRow, ...]
    totals: dict[str, QualityTotal]
    speed_seconds: tuple[_Finite, ...] = Field(
        description="Number of windows of one second in each bin of `speed_edges_m_s`."
    )
    turn_seconds: tuple[_Finite, ...] = Field(
        description="Number of windows of one second in each bin of `turn_edges_deg_s`."
    )


class QualityChange(Request):
    """Total of a measure minus the total of the reference clips, with the 95 % interval of the difference."""

    value: _Finite
    low: _Finite | None
    high: _Finite | None


class QualityDocument(Request):
    """Result of a job of the kind `quality`: the measures of each clip, totals, and a comparison with a reference."""

    schema_: Literal["marey/quality@1"] = Field("marey/quality@1", alias="schema")
    code_version: str = Field(description="Version of Marey.")
    conditions: QualityConditions
    units: dict[str, str] = Field(description="Unit of each measure; empty for shares.")
    speed_edges_m_s: tuple[float, ...] = SPEED_EDGES_M_S
    turn_edges_deg_s: tuple[float, ...] = TURN_EDGES_DEG_S
    measured: MeasuredSet
    reference: MeasuredSet | None = Field(
        None, description="Measurements of the reference clips (ground truth); null if no reference was given."
    )
    changes: dict[str, QualityChange] = Field(
        default_factory=dict, description="Total of the clips minus the total of the reference, by measure."
    )
    refused: tuple[dict[str, str], ...] = Field((), description="Clips that could not be measured, with the reasons.")


def worst_clips_first(clips: Iterable[QualityRow]) -> list[QualityRow]:
    """Sort clips by the main measure, the greatest value first; clips without a value come last."""
    return worst_first(clips, lambda clip: clip.values[MAIN_MEASURE], lambda clip: clip.name)


def differing_conditions(one: QualityConditions, other: QualityConditions) -> dict[str, tuple[object, object]]:
    """Return the conditions that differ, by name, with both values; numbers of equal conditions can be compared."""
    flat = [{**each.model_dump(exclude={"options"}), **each.options.model_dump()} for each in (one, other)]
    return {name: (value, flat[1][name]) for name, value in flat[0].items() if value != flat[1][name]}


def command_with(conditions: QualityConditions) -> str:
    """Return the `marey quality` command that measures under given conditions."""
    usual = QualityOptions().model_dump()
    chosen = {name: value for name, value in conditions.options.model_dump().items() if value != usual[name]}
    stated = {**chosen, "draws": conditions.draws, "seed": conditions.seed}
    contacts = ["--contacts …"] if conditions.contacts == "annotated" else []
    return " ".join(
        ["marey quality …", *contacts, *(f"--{name.replace('_', '-')} {value}" for name, value in stated.items())]
    )

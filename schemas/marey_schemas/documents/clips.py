"""Clips: their motions, and descriptions of their origin.

Lengths are in metres, times in seconds. Quaternions are w,x,y,z. Axes are right-handed with Y up
(docs/explanation/conventions.md).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from datetime import date
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, StringConstraints, model_validator

from marey_schemas.base import Request
from marey_schemas.documents.references import OutputRef as OutputRef
from marey_schemas.documents.references import RevisionRef as RevisionRef
from marey_schemas.documents.skeletons import MAX_JOINTS
from marey_schemas.encoding.arrays import ArrayOf
from marey_schemas.names import Digest, JointName, Tag, form

MAX_FRAME_RATE_HZ = 100_000.0
MIN_FRAME_RATE_HZ = 1e-6
"""Lowest frame rate of a clip, in hertz. At much lower rates, the duration of a clip would not be a finite number."""

UNIT_TOLERANCE = 1e-3
"""Greatest difference from 1 of the length of a quaternion that is accepted as a rotation."""


class MotionDocument(Request):
    """Part `motion` of a clip: the poses."""

    schema_: Literal["marey/motion@1"] = Field("marey/motion@1", alias="schema")
    skeleton: RevisionRef | OutputRef
    frame_rate_hz: float = Field(ge=MIN_FRAME_RATE_HZ, le=MAX_FRAME_RATE_HZ, allow_inf_nan=False)
    joints: tuple[JointName, ...] = Field(
        min_length=1, max_length=MAX_JOINTS, description="Order of the joints' rotations in `poses`."
    )
    poses: Annotated[NDArray[np.float32], ArrayOf("<f4", ndim=2)] = Field(
        description="[frames, 3 + 4*joints]: root translation (m), then local quaternions."
    )
    translations: Annotated[NDArray[np.float32], ArrayOf("<f4", ndim=3, columns=3)] | None = Field(
        None,
        description="[frames, k, 3]: local translations (m) of the joints `translated_joints`, which "
        "replace their offsets.",
    )
    translated_joints: tuple[JointName, ...] = ()

    @model_validator(mode="after")
    def _check_shapes(self) -> Self:
        frames, width = self.poses.shape
        if frames < 1:
            raise ValueError("poses: a motion needs at least one frame")
        if width != 3 + 4 * len(self.joints):
            raise ValueError(
                f"poses: the array has {width} columns, but {len(self.joints)} joints need {3 + 4 * len(self.joints)}"
            )
        if (self.translations is None) != (not self.translated_joints):
            raise ValueError("translations and translated_joints: give both or neither")
        if self.translations is not None and self.translations.shape != (frames, len(self.translated_joints), 3):
            raise ValueError(
                f"translations: the array has the shape {self.translations.shape}, but must have "
                f"{(frames, len(self.translated_joints), 3)}"
            )
        if unknown := set(self.translated_joints) - set(self.joints):
            raise ValueError(f"translated_joints: {sorted(unknown)} are not joints of the motion")
        return self

    def find_wrong_rotation(self) -> tuple[int, int, float] | None:
        """Return frame, joint and length of the first quaternion that is not a rotation; None if all are rotations."""
        rotations = self.poses[:, 3:].reshape(len(self.poses), len(self.joints), 4).astype(np.float64)
        lengths = np.sqrt(np.einsum("fjc,fjc->fj", rotations, rotations))
        wrong = np.abs(lengths - 1) > UNIT_TOLERANCE
        if not wrong.any():
            return None
        frame, joint = (int(index) for index in np.argwhere(wrong)[0])
        return frame, joint, float(lengths[frame, joint])


class Check(Request):
    """Warning about a motion, from an import, a retargeting or an edit: a stable code, a message, joints and frames."""

    code: Annotated[
        str, StringConstraints(pattern=form(r"^[a-z0-9-]{1,64}$", "have 1 to 64 lower-case letters, digits and -"))
    ]
    message: str
    joints: tuple[str, ...] = ()
    frames: tuple[int, int] | None = Field(
        None, description="Half-open range of frames that the warning concerns; null: all frames."
    )
    values: dict[str, Any] = Field(default_factory=dict)


class ClipSource(Request):
    """Origin of a clip, and the changes made by the importer."""

    file: Digest | None = Field(
        None, description="Digest of the blob with the imported file, byte for byte; absent if the file is not stored."
    )
    file_name: str | None = Field(None, description="Name of the file without its folders.")
    companion: Digest | None = Field(
        None,
        description="Digest of the blob with a second file that the format needs, such as the ASF of an "
        "AMC; absent: there is none.",
    )
    companion_name: str | None = None
    content: Digest | None = Field(
        None,
        description="Content digest of the part `motion` as it was read from a file of Marey's predecessor; absent "
        "for files in other formats, and if the import changed the motion.",
    )
    format: str | None = None
    details: dict[str, Any] = Field(
        default_factory=dict,
        description="Facts about the import: unit scale, axes, channel orders, trimmed frames and floor shift, with "
        "the evidence for each.",
    )


_DAY = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}")


def _require_day(value: object) -> object:
    """Return the value; raise ValueError unless it is a `date` or a text in the form `2026-11-23`.

    Other forms are refused, because documents are stored as they were sent, and days are compared as texts.
    """
    is_day = _DAY.fullmatch(value) if isinstance(value, str) else type(value) is date
    if is_day:
        return value
    raise ValueError("a day must be written as in 2026-11-23")


Day = Annotated[date, BeforeValidator(_require_day)]
"""Date; as a text, it has the form `2026-11-23`."""


class TakeRecord(Request):
    """Facts about the recording that a clip comes from; lists of clips show them, and queries can filter by them."""

    subject: str | None = Field(None, description="Performer, under a pseudonym; absent: not recorded.")
    action: str | None = Field(None, description="What the performer does, such as `walk`; absent: not recorded.")
    take: str | None = Field(None, max_length=64, description="Take, as the studio numbers it; absent: not recorded.")
    shoot_day: Day | None = Field(None, description="Day of the recording; absent: not recorded.")
    select: Literal["best", "good", "no good"] | None = Field(
        None, description="Rating of the take by the director; absent: not rated."
    )
    licence: str | None = Field(None, description="Licence of the recording; absent: not recorded.")
    capture_system: str | None = Field(None, description="System that recorded the motion; absent: not recorded.")
    consent_until: Day | None = Field(
        None,
        description="Last day of the performer's consent; clips are not exported after this day, in UTC. Absent: "
        "no last day is recorded.",
    )


class RecordingFacts(TakeRecord):
    """Facts about a recording that its motion file does not contain."""

    consent_for: tuple[Annotated[str, StringConstraints(min_length=1, max_length=64)], ...] | None = Field(
        None, max_length=32, description="Purposes for which the performer gave consent; absent: not recorded."
    )
    comment: str | None = None


def with_earlier_facts(info: Mapping[str, Any], earlier: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part `info` of a clip, in which absent facts about the recording are taken from an earlier revision.

    If both revisions state the last day of the consent, the earlier day counts. If both revisions state the purposes of
    the consent, only the purposes that occur in both revisions count.

    The earlier warnings are kept if the same file was imported in the same way, and if the new warnings differ from
    them only in their messages. So no revision is added because a newer version of Marey words a warning differently.
    """
    names = [name for name in RecordingFacts.model_fields if info.get(name) is None and earlier.get(name) is not None]
    kept = {**info, **{name: earlier[name] for name in names}}
    if info.get("consent_until") is not None and earlier.get("consent_until") is not None:
        kept["consent_until"] = min(info["consent_until"], earlier["consent_until"])
    if info.get("consent_for") is not None and earlier.get("consent_for") is not None:
        kept["consent_for"] = [one for one in info["consent_for"] if one in earlier["consent_for"]]
    source, checks = info.get("source") or {}, earlier.get("checks")
    if checks and source.get("file") and source == earlier.get("source") and _findings(info) == _findings(earlier):
        kept["checks"] = checks
    return kept


def _findings(info: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the warnings of the part `info` of a clip without their messages."""
    return [{name: value for name, value in check.items() if name != "message"} for check in info.get("checks", ())]


class ClipInfo(RecordingFacts):
    """Part `info` of a clip: descriptions by users and importers."""

    schema_: Literal["marey/clip-info@1"] = Field("marey/clip-info@1", alias="schema")
    tags: tuple[Tag, ...] = ()
    source: ClipSource | None = None
    checks: tuple[Check, ...] = ()

    def with_consent_of(self, others: Iterable[ClipInfo]) -> Self:
        """Return a copy of this description whose consent is at least as strict as its own and those of `others`.

        `others` are the descriptions of clips from which this clip contains motion. The last day of the consent is the
        earliest of the last days of all these clips. The purposes are those that all clips have in common; clips
        without recorded purposes are ignored.
        """
        infos: tuple[ClipInfo, ...] = (self, *others)
        days = [one.consent_until for one in infos if one.consent_until is not None]
        purposes = [one.consent_for for one in infos if one.consent_for is not None]
        common = tuple(one for one in purposes[0] if all(one in each for each in purposes)) if purposes else None
        return self.model_copy(update={"consent_until": min(days, default=None), "consent_for": common})

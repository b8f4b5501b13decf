"""Keyword arguments of methods of the SDK: options of imports, searches and other requests that are not jobs.

Written by `make docs` from the declarations of the options; change them there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

from marey_schemas.kinds import Kind
from marey_schemas.search import SearchStep, StartPlacement


class ImportKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `ImportOptions`."""

    collection: str
    """Folder of the project that receives the clips."""
    skeleton: str | None
    """Item id of the skeleton that the clips must use. `marey upload` also accepts its address (project/folder/name),
    and Python its path. Absent: the skeleton of the file is used; it is created if the project does not have it."""
    unit: Literal["mm", "cm", "inch", "cmu", "dm", "ft", "m"] | None
    """Unit of length of the files; cmu is 1/0.45 inch. Absent: inferred."""
    unit_scale_m: float | None
    """Metres per unit of length, for units without a name; an alternative to `unit`. Absent: inferred."""
    up_axis: Literal["x", "y", "z", "-x", "-y", "-z"] | None
    """Axis that points up in the files. Absent: inferred."""
    handedness: Literal["right", "left"]
    """Handedness of the axes in the files. left: the motion is mirrored."""
    align_floor: bool
    """Shift each clip vertically, so that its feet are on the ground at height 0."""
    frame_rate_hz: float | None
    """Frame rate of the clips, in hertz. Absent: the rate in the files."""
    trust_options: bool
    """Use unit, up axis and frame rate as given, even if the motion contradicts them; otherwise, files with a
    contradiction are refused."""
    end_index: Literal["inclusive", "exclusive"] | None
    """Meaning of `end_idx`, the last index of a section in annotation files of Marey's predecessor. inclusive: the
    section includes this frame, as in the predecessor's editor; exclusive: it ends before this frame, as in the
    predecessor's time warping. Absent: exclusive if sections would overlap otherwise, else inclusive."""
    replace_skeleton: bool
    """Make a new revision of a clip or model of the same name, even if the file has another skeleton; otherwise, a file
    with another skeleton is refused."""
    trim_rest_pose: bool
    """Remove rest poses at the beginning and at the end of each clip."""
    tags: list[str] | tuple[str, ...]
    """Tags that every clip gets."""
    subject: str | None
    """Performer, under a pseudonym."""
    licence: str | None
    """Licence of the data."""
    capture_system: str | None
    """The device or system that recorded the data."""


class DifferenceKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `DifferenceOptions`."""

    threshold_deg: float
    """Threshold in degrees: the times at which a joint's rotation changed by more than this are listed."""
    threshold_cm: float
    """Threshold in centimetres: the times at which a position changed by more than this are listed."""


class LineageKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `LineageOptions`."""

    direction: Literal["inputs", "results", "both"]
    """`inputs`: the revisions from which the revision was made; `results`: the revisions that were made from it;
    `both`: inputs and results."""
    depth: int
    """Greatest number of jobs between the revision whose lineage is shown and any other revision of the graph."""


class EditPreviewKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `EditPreviewRequest`."""

    revision: int | None
    """Revision of the clip; absent: the newest."""
    piece: int
    """Index of the result to return, if the commands split the clip."""
    fields: Sequence[Literal["motion", "positions", "findings"]]
    """Content of the answer, in addition to the numbers of clips and frames."""


class SearchKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `SearchRequest`."""

    likelihood_weight: float | None
    """Weight of the motion's likelihood; smaller values bring the motion closer to the targets. Absent: 0.01, or 0 if
    the errors would otherwise become larger than before the refinement."""
    iterations: int
    """Greatest number of iterations of the optimisation."""
    steps: Sequence[SearchStep | Mapping[str, Any]]
    """Several motions; each begins where the previous motion ends."""
    start: StartPlacement | Mapping[str, Any]
    candidates: int
    """Number of nodes of the tree that the search follows at each level."""
    passes: int
    """Number of passes. The first pass searches the samples of the tree; each further pass searches near the best
    samples so far."""
    refine: bool
    """Improve the result of the tree by numerical optimisation."""
    transition_tolerance_m: float
    """Size of a jump between two steps that counts as an error of 1, in metres; jumps of hands, feet and the height of
    the pelvis are measured."""
    transition_tolerance_cm: float | None
    """Deprecated: use `transition_tolerance_m`. This field of release 0.1 is in centimetres."""
    finish: bool
    """Remove the remaining errors of joint positions by inverse kinematics."""
    seed: int
    """Seed of the samples that are drawn if the model has no tree."""
    motion: bool
    """Include the motion in the answer."""


class SimilarKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `SimilarOptions`."""

    results: int
    """Greatest number of moments to return."""
    mirrored: bool
    """Also find moments that resemble the example with left and right exchanged."""
    leave_out: Literal["window", "clip", "nothing"]
    """Moments of the example's own clip to leave out: those that overlap the example, all, or none."""
    index: str | None
    """Id of the index to search; absent: the index of the project that was updated last."""


class PurgeKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `PurgeRequest`."""

    item: str | None
    """Id of one deleted item; absent: the other conditions select the items."""
    path: str | None
    """Path, made of folder and name, that deleted items had."""
    collection: str | None
    """Folder whose deleted items are purged, including those in folders below it; empty: the deleted items of the whole
    project."""
    kind: Kind | str | None
    """Kind of the items; absent: all kinds."""
    query: str | None
    """Query that the items meet, such as `subject = 02`; absent: any items."""
    older_than_days: int | None
    """Only items that were deleted at least this number of days ago; absent: all."""
    preview: bool
    """Report what a purge would do, but change nothing."""
    after: str | None
    """Value of `next` in the previous answer, to continue a purge of many items; absent: the purge begins."""

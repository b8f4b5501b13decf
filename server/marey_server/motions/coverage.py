"""Coverage of streams of recorded frames: the number of seconds of motion at each speed and turn rate.

One transaction reads the row of a stream; a child process then computes the coverage.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from marey_schemas.coverage_streams import (
    CoverageCell,
    CoverageFrames,
    CoverageProgress,
    CoverageStreamCreate,
    CoverageTarget,
    MeasuredCoverage,
    Performer,
)
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.skeletons import SkeletonHierarchy, SkeletonMapping
from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree
from marey_schemas.encoding.digests import digest_of_hash
from marey_schemas.kinds import Kind
from marey_schemas.options.evaluation import MOST_FRAME_RATE_HZ
from marey_schemas.problems import FieldError
from marey_schemas.validation.reasons import first_reason
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.motions.child import Message, pack_tree, unpack_tree
from marey_server.store import items, projects
from marey_server.store.coverage_streams import Stream, answered_before, require_offset
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:  # numeric modules are loaded by children alone
    from marey_motion.evaluation.online import OnlineCoverage, Target
    from marey_motion.matching.body import MatchingBody

Tree = dict[str, Any]
CACHED_BODIES = 32
BEGIN_COVERAGE = "marey_server.motions.coverage:begin_coverage"
LOOK_AT_COVERAGE = "marey_server.motions.coverage:look_at_coverage"
ADVANCE_COVERAGE = "marey_server.motions.coverage:advance_coverage"
"""Function that child processes run; so are `BEGIN_COVERAGE` and `LOOK_AT_COVERAGE`."""


@dataclass(frozen=True, slots=True)
class StreamInputs:
    """References and documents that a request for a new stream names.

    `skeleton` and `evaluation` are references to revisions (item and revision). `rig` is the encoded skeleton with its
    joint mapping. `measured` is the document of the evaluation (its part `evaluation`).
    """

    skeleton: Tree | None = None
    rig: bytes | None = None
    evaluation: Tree | None = None
    measured: Tree | None = None


class BeginOrder(Message):
    """Message that asks a child process to start a stream; `measured` is the document of the evaluation as bytes."""

    request: CoverageStreamCreate
    skeleton: Tree | None
    rig: bytes | None
    evaluation: Tree | None
    measured: bytes | None

    def inputs(self) -> StreamInputs:
        """Return the references and documents in the message, with the decoded document of the evaluation."""
        return StreamInputs(
            self.skeleton, self.rig, self.evaluation, None if self.measured is None else unpack_tree(self.measured)
        )


class StreamOrder(Message):
    """Message that asks a child process to add `frames` to a stored stream.

    If `frames` is None, the child process only computes the coverage of the stream. `rig` is the skeleton of the
    stream's poses with its joint mapping, as bytes.
    """

    settings: Tree
    rig: bytes | None
    state: bytes
    frames: bytes | None = None


@dataclass(frozen=True, slots=True)
class NextFrames:
    """Message, as bytes, that asks a child process to add the frames of a request, and the digest of these frames."""

    digest: str
    order: bytes


class BegunStream(Message):
    """New stream, and the members of `CoverageStreamState` that were computed for it."""

    settings: Tree
    state: bytes
    shown: Tree


class AdvancedStream(Message):
    """New state of a stream to which frames were added, and the answer to the request that sent these frames."""

    answer: Tree
    offset: int
    state: bytes


def read_stream_inputs(tx: Transaction, project: str, request: CoverageStreamCreate) -> StreamInputs:
    """Return the references and documents that a request for a new stream names.

    Raises `NotFoundProblem` if the skeleton or the evaluation does not exist.
    """
    projects.require(tx, project)
    skeleton = rig = evaluation = measured = None
    if request.skeleton is not None:
        hierarchy = items.read_part(tx, project, Kind.SKELETON, request.skeleton, "hierarchy")
        skeleton = {"item": request.skeleton, "revision": hierarchy.revision}
        mapping = _mapping(tx, project, request.skeleton, hierarchy.revision)
        rig = encode_tree({"hierarchy": hierarchy.tree, "mapping": mapping}, MSGPACK)
    if request.evaluation is not None:
        part = items.read_part(tx, project, Kind.EVALUATION, request.evaluation, "evaluation")
        evaluation = {"item": request.evaluation, "revision": part.revision}
        measured = part.tree
    return StreamInputs(skeleton, rig, evaluation, measured)


def _mapping(tx: Transaction, project: str, skeleton: str, revision: int) -> Tree | None:
    try:
        return items.read_part(tx, project, Kind.SKELETON, skeleton, "mapping", revision=revision).tree
    except NotFoundProblem:  # an optional part: without it, the mapping is guessed
        return None


def begin_order(request: CoverageStreamCreate, inputs: StreamInputs) -> bytes:
    """Return the packed message that asks a child process to start a stream."""
    return BeginOrder(
        request=request,
        skeleton=inputs.skeleton,
        rig=inputs.rig,
        evaluation=inputs.evaluation,
        measured=None if inputs.measured is None else pack_tree(inputs.measured),
    ).pack()


def look_order(stream: Stream) -> bytes:
    """Return the packed message that asks a child process to compute the coverage of a stream in each cell.

    A cell is a range of speeds and turn rates.
    """
    return StreamOrder(settings=stream.settings, rig=stream.rig, state=stream.state).pack()


def next_frames(held: Stream, frames: CoverageFrames) -> NextFrames | Tree:
    """Return the message that asks a child process to add the frames of a request to a stream.

    If the request repeats the previous request, the stored answer to that request is returned instead. Raises
    `CoverageOffset` if the frames do not start at the stream's offset.
    """
    digest = _digest_of(frames)
    if (answer := answered_before(held, digest)) is not None:
        return answer
    require_offset(held, frames.offset)
    packed = encode_tree(frames.model_dump(), MSGPACK)
    order = StreamOrder(settings=held.settings, rig=held.rig, state=held.state, frames=packed)
    return NextFrames(digest, order.pack())


def _digest_of(frames: CoverageFrames) -> str:
    """Return the digest of a request's frames and offset, independent of the media type."""
    hashed = hashlib.sha256(f"{frames.offset} {frames.ends_take}".encode())
    hashed.update("/".join(frames.translated_joints).encode())
    for name in ("poses", "translations", "roots"):
        given = getattr(frames, name)
        if given is not None:
            hashed.update(f" {name} {given.dtype.str} {given.shape} ".encode())
            hashed.update(given.tobytes())
    return digest_of_hash(hashed)


# -- in the child ------------------------------------------------------------------------------------------------------


def begin_coverage(packed: bytes) -> bytes:
    """Start a stream, in a child process. `packed` is a `BeginOrder`, and the result a `BegunStream`, both as bytes."""
    order = BeginOrder.unpack(packed)
    return begin(order.request, order.inputs()).pack()


def look_at_coverage(packed: bytes) -> bytes:
    """Compute the coverage of a stream, in a child process. `packed` is a `StreamOrder` as bytes.

    Return the computed members of `CoverageStreamState` as MessagePack.
    """
    order = StreamOrder.unpack(packed)
    return encode_tree(_state(_online(order.state), order.settings), MSGPACK)


def advance_coverage(packed: bytes) -> bytes:
    """Add frames to a stream, in a child process. `packed` is a `StreamOrder` with frames, as bytes.

    Return an `AdvancedStream` as bytes. Raises `InvalidProblem` if the frames do not fit the stream.
    """
    order = StreamOrder.unpack(packed)
    return advance(order, CoverageFrames.model_validate(unpack_tree(order.frames or b""))).pack()


def begin(request: CoverageStreamCreate, inputs: StreamInputs) -> BegunStream:
    """Start a coverage stream, and return its state.

    Raises `InvalidProblem` if the skeleton or the evaluation cannot be used.
    """
    from marey_motion.evaluation.online import OnlineCoverage
    from marey_schemas.options.evaluation import COVERAGE_LEAST_S, Grid

    asked = request.model_dump(include={"speeds_m_s", "turn_rates_deg_s"}, exclude_none=True)
    grid = Grid(**asked)
    least_s, seconds = request.least_s or COVERAGE_LEAST_S, None
    if inputs.evaluation is not None:
        with refusing("evaluation"):
            found = MeasuredCoverage.model_validate(inputs.measured)
        grid = found.options.grid
        least_s, seconds = found.options.coverage_least_s, found.coverage.seconds
    with refusing("evaluation"):  # a grid that the request gives has been checked
        online = OnlineCoverage(request.frame_rate_hz, grid, least_s=least_s, seconds=seconds)
    with refusing("skeleton"):
        _load_kernels(None if inputs.rig is None else body_of(inputs.rig))
    settings = {
        "frame_rate_hz": request.frame_rate_hz,
        "skeleton": inputs.skeleton,
        "evaluation": inputs.evaluation,
        "speeds_m_s": np.unique(grid.speeds_m_s).tolist(),
        "turn_rates_deg_s": np.unique(grid.turn_rates_deg_s).tolist(),
        "least_s": least_s,
        "target_count": request.target_count,
        "path_s": request.path_s,
    }
    return BegunStream(settings=settings, state=_packed(online), shown=_state(online, settings))


def advance(order: StreamOrder, frames: CoverageFrames) -> AdvancedStream:
    """Add frames to a stream; return its new state and the answer to the request.

    Raises `InvalidProblem` if the frames do not fit the stream.
    """
    online = _online(order.state)
    before = online.counts.copy()
    windows = 0
    if frames.poses is not None and frames.frame_count:
        windows += _add_poses(online, order, frames)
    if frames.roots is not None:
        roots = frames.roots.astype(np.float64)
        with refusing("roots"):
            windows += len(online.add_roots(roots[:, :2], roots[:, 2]).speed_m_s)
    if frames.ends_take:
        windows += len(online.end_take().speed_m_s)
    progress = CoverageProgress(
        offset=online.frame_count,
        windows=windows,
        changed=_cells(online, np.argwhere(online.counts != before)),
        **_now(online, order.settings),
    )
    return AdvancedStream(answer=progress.model_dump(mode="json"), offset=online.frame_count, state=_packed(online))


def _online(state: bytes) -> OnlineCoverage:
    from marey_motion.evaluation.online import OnlineCoverage

    return OnlineCoverage.from_tree(decode_tree(state, MSGPACK))


def _add_poses(online: OnlineCoverage, order: StreamOrder, frames: CoverageFrames) -> int:
    """Add the poses of a request to the stream.

    Return the number of time windows of the coverage measure that these poses complete. Raises `InvalidProblem` if the
    stream has no skeleton, or the poses do not fit its skeleton.
    """
    from marey_motion.documents import clip_from_document

    if order.rig is None:
        fault = _fault("/poses", "no-skeleton", "Poses need a skeleton.")
        raise InvalidProblem(
            "Poses need a skeleton, but the stream was created without one; send root positions, or create a "
            "stream with a skeleton.",
            code="no-skeleton",
            errors=[fault],
        )
    with refusing("poses"):
        body = body_of(order.rig)
        motion = {
            "skeleton": order.settings["skeleton"],
            "frame_rate_hz": order.settings["frame_rate_hz"],
            "joints": body.skeleton.joint_names,
            "poses": _single(frames.poses),
            "translations": _single(frames.translations),
            "translated_joints": frames.translated_joints,
        }
        clip = clip_from_document(MotionDocument.model_validate(motion), body.skeleton)
        return len(online.add_frames(body, clip).speed_m_s)


def _single(array: NDArray[Any] | None) -> NDArray[np.float32] | None:
    """Convert numbers to single precision, in which clips are stored; None stays None.

    Values that are too large become infinite, and are refused later.
    """
    with np.errstate(over="ignore"):
        return None if array is None else array.astype(np.float32)


@lru_cache(maxsize=CACHED_BODIES)
def body_of(rig: bytes) -> MatchingBody:
    """Return the `MatchingBody`, which contains the skeleton of a stream with its mapped joints.

    Raises `MotionError` if joints that define a direction are not mapped, or if a person must check the mapping first.
    """
    from marey_motion.documents import skeleton_from_document, trusted_mapping
    from marey_motion.matching.body import MatchingBody

    tree = decode_tree(rig, MSGPACK)
    skeleton = skeleton_from_document(SkeletonHierarchy.model_validate(tree["hierarchy"]))
    stored = None if tree["mapping"] is None else SkeletonMapping.model_validate(tree["mapping"])
    return MatchingBody.from_mapping(skeleton, trusted_mapping(stored, skeleton)[0])


def _load_kernels(body: MatchingBody | None) -> None:
    """Load the compiled kernels that frames of this skeleton need, so that the first frames do not wait for them."""
    from marey_motion.clip import Clip
    from marey_motion.evaluation.online import OnlineCoverage

    trial = OnlineCoverage(MOST_FRAME_RATE_HZ)
    trial.add_roots(np.zeros((1, 2)), np.zeros(1))
    if body is not None:
        pose = np.array([[0.0] * 3 + [1.0, 0.0, 0.0, 0.0] * body.skeleton.joint_count], dtype=np.float32)
        trial.add_frames(body, Clip(body.skeleton, MOST_FRAME_RATE_HZ, pose))
    trial.end_take()


@contextmanager
def refusing(field: str) -> Iterator[None]:
    """Convert motion and validation errors in the `with` block to an `InvalidProblem` for a field of the request."""
    from marey_motion.errors import MotionError

    try:
        yield
    except MotionError as error:
        raise InvalidProblem(
            str(error), code=error.code, errors=[_fault(f"/{field}", error.code, str(error))]
        ) from error
    except ValidationError as error:
        detail = first_reason(error)
        fault = _fault(f"/{field}", "invalid", detail)
        raise InvalidProblem(f"The request is not valid: {fault.pointer}: {detail}", errors=[fault]) from error


def _fault(pointer: str, code: str, detail: str) -> FieldError:
    return FieldError(pointer=pointer, code=code, detail=detail)


def _packed(online: OnlineCoverage) -> bytes:
    return encode_tree(online.as_tree(), MSGPACK)


# -- numbers as they travel -------------------------------------------------------------------------------------------


def _state(online: OnlineCoverage, settings: Tree) -> Tree:
    return {
        **_now(online, settings),
        "seconds": online.seconds.tolist(),
        "deficit_s": online.deficit_s.tolist(),
        "delay_s": online.delay_s,
    }


def _now(online: OnlineCoverage, settings: Tree) -> Tree:
    """Return the members of `CoverageNow` for a stream: missing seconds, motions to record next, and performer."""
    targets = online.targets(settings["target_count"], path_s=settings["path_s"])
    performer = _performer(online)
    return {
        "index": online.index,
        "missing_s": float(online.deficit_s.sum()),
        "targets": [_target(target).model_dump() for target in targets],
        "performer": None if performer is None else performer.model_dump(),
    }


def _target(target: Target) -> CoverageTarget:
    hole, path = target.hole, target.path
    return CoverageTarget(
        speed_m_s=hole.speed_m_s,
        turn_rate_deg_s=hole.turn_rate_deg_s,
        seconds=hole.seconds,
        deficit_s=hole.deficit_s,
        path=tuple(map(tuple, np.column_stack((path.positions, path.headings)).tolist())),
        path_step_s=1.0 / path.rate_hz,
    )


def _cells(online: OnlineCoverage, places: NDArray[np.intp]) -> tuple[CoverageCell, ...]:
    speeds, turn_rates = np.unique(online.grid.speeds_m_s), np.unique(online.grid.turn_rates_deg_s)
    seconds, deficits = online.seconds, online.deficit_s
    return tuple(
        CoverageCell(
            speed_m_s=float(speeds[v]),
            turn_rate_deg_s=float(turn_rates[w]),
            seconds=float(seconds[v, w]),
            deficit_s=float(deficits[v, w]),
        )
        for v, w in places.tolist()
    )


def _performer(online: OnlineCoverage) -> Performer | None:
    performer = online.performer
    if performer is None:
        return None
    window = performer.window
    return Performer(
        x_m=performer.x_m,
        z_m=performer.z_m,
        heading_rad=performer.heading_rad,
        speed_m_s=None if window is None else float(window.speed_m_s),
        turn_rate_deg_s=None if window is None else float(np.degrees(window.turn_rate_rad_s)),
        forward_m_s=None if window is None else float(window.forward_m_s),
        strafe_m_s=None if window is None else float(window.strafe_m_s),
    )

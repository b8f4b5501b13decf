"""Searches in a child process, and their results: motions, and the error of each constraint."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees, radians
from typing import TYPE_CHECKING, Any

from marey_schemas.documents.references import RevisionRef
from marey_schemas.formats import MotionFormat, WrittenUnit
from marey_schemas.options.searching import RefineOptions, TransitionOptions
from marey_schemas.problems import FieldError
from marey_schemas.search import ConstraintError, FoundStep, SearchAnswer, SearchRequest, StartPlacement
from marey_schemas.search_constraints import JointPositionConstraint, RootPositionConstraint, SearchConstraint
from marey_server.errors import InvalidProblem, TooLargeProblem
from marey_server.motions import searching
from marey_server.motions.child import AnswerEncoding, ComputedFile, Message
from marey_server.motions.models import LARGEST_ANSWER_BYTES
from marey_server.motions.searching import FoundSearchable, Searchable, SearchedModels, usable_searchables

if TYPE_CHECKING:
    from marey_motion.alignment.aligned import Placement
    from marey_motion.clip import Clip
    from marey_motion.modelling.search.finishing import Finished
    from marey_motion.modelling.search.found_motions import FoundMotion
    from marey_motion.modelling.search.step_search import Sequel
    from marey_motion.modelling.search.steps import Step


ANSWER_SEARCH = "marey_server.motions.search_answers:answer_search"
WRITE_SEARCH = "marey_server.motions.search_answers:write_search"
"""Function that child processes run; so is `ANSWER_SEARCH`."""
FAR_CM = 5.0
"""Error in cm, before inverse kinematics, above which a position constraint counts as out of the model's reach."""

MOST_WORK = 3e9
"""Greatest cost of a search, in nanoseconds of one thread (estimated)."""

UNITS = {
    "joint_position": "cm", "root_position": "cm", "joint_orientation": "deg", "look_direction": "deg",
    "root_heading": "deg", "keyframe_time": "s",
}  # fmt: skip
CM = 0.01


@dataclass(frozen=True, slots=True)
class SearchLimits:
    """Limits on the estimated computing time of a search, in nanoseconds of one thread.

    `work` limits the search itself; `drawing_work` limits the drawing of samples for models without a stored tree.
    """

    work: float
    drawing_work: float


class SearchOrder(Message):
    """Message that asks a child process to run a search.

    A search consists of steps; each step searches one model for one motion.
    """

    request: SearchRequest
    models: SearchedModels
    limits: SearchLimits

    def search(self) -> tuple[SearchResult, list[Searchable]]:
        """Run the search; return its result, and the parsed model of each step."""
        usable = usable_searchables(self.models, self.request.seed, self.limits.drawing_work)
        return search(usable, self.request, self.limits.work), usable


class SearchAnswerOrder(SearchOrder):
    """Message that asks a child process to answer a search with a document."""

    encoding: AnswerEncoding


class SearchFileOrder(SearchOrder):
    """Message that asks a child process to answer a search with a motion file."""

    format: MotionFormat
    unit: WrittenUnit


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Motions found by a search, in world coordinates and real time."""

    steps: tuple[Step, ...]
    sequel: Sequel
    found: FoundMotion
    finished: Finished | None

    @property
    def clip(self) -> Clip:
        """The motions of all steps, joined into one clip, after inverse kinematics if the request asks for it."""
        last = self.found if self.finished is None else self.finished.found
        return last.motion.as_clip(last.skeleton, last.frame_rate_hz)


def search_limits() -> SearchLimits:
    """Return the limits that apply to every search."""
    return SearchLimits(MOST_WORK, searching.MOST_DRAWING_WORK)


# -- in the child ------------------------------------------------------------------------------------------------------


def answer_search(packed: bytes) -> bytes:
    """Search models for motions, in a child process. `packed` is a `SearchAnswerOrder` as bytes.

    Return the document of the answer, encoded for the client.
    """
    order = SearchAnswerOrder.unpack(packed)
    result, usable = order.search()
    return order.encoding.encode(answer_of(result, usable, order.models.found, order.request))


def write_search(packed: bytes) -> bytes:
    """Search models and write found motions to a file, in a child process. `packed` is a `SearchFileOrder` as bytes.

    Return a `ComputedFile` as bytes.
    """
    order = SearchFileOrder.unpack(packed)
    return file_of(order.search()[0], order.models.found, order.format, order.unit).pack()


def search(searchables: Sequence[Searchable], request: SearchRequest, most_work: float) -> SearchResult:
    """Search the models of all steps for the motions that a request describes.

    `most_work` limits the estimated computing time, in nanoseconds of one thread. Raises `InvalidProblem` with a JSON
    Pointer to the faulty constraint. Raises `TooLargeProblem` if the search would take longer, or if the found motion
    has too many frames for one answer.
    """
    from marey_motion.errors import MotionError
    from marey_motion.modelling.search import work as search_work
    from marey_motion.modelling.search.finishing import finish_motion
    from marey_motion.modelling.search.found_motions import found_motion
    from marey_motion.modelling.search.step_search import search_steps
    from marey_motion.modelling.search.steps import SeveralSteps

    steps, trees = _steps_of(searchables, request), [one.tree for one in searchables]
    refining = RefineOptions.of(request) if request.refine else None
    effort = {"candidates": request.candidates, "passes": request.passes}
    try:
        work = search_work.searching_work(SeveralSteps.of(steps), trees, refining=refining, **effort)
        _require_quick(work, most_work)
        start = placement_of(request.start)
        transitions = TransitionOptions(tolerance_m=request.transition_tolerance_m)
        sequel = search_steps(steps, trees, start=start, refining=refining, transitions=transitions, **effort)
        _require_room(steps, sequel)
        found, finished = found_motion(steps, sequel), None
        if request.finish:
            _require_quick(work + search_work.finishing_work(steps, found), most_work)
            finished = finish_motion(steps, found, searchables[0].mapping)
    except MotionError as error:
        raise _invalid(request, error) from error
    return SearchResult(steps, sequel, found, finished)


def _require_quick(work: float, most_work: float) -> None:
    if work > most_work:
        raise TooLargeProblem(
            f"This search takes about {work / most_work:.1f} times as long as allowed; request fewer steps, "
            "constraints, candidates, passes or iterations.",
            code="search-too-large",
        )


def _require_room(steps: Sequence[Step], sequel: Sequel) -> None:
    pairs = [(step.primitive, latent[None]) for step, latent in zip(steps, sequel.latents, strict=True)]
    frames = sum(float(primitive.time_functions(latent)[0, -1]) + 1.5 for primitive, latent in pairs)
    size = frames * steps[0].primitive.spatial.mean.shape[1] * 4
    if not size <= LARGEST_ANSWER_BYTES:
        raise TooLargeProblem(
            f"The motion that was found has {frames:,.0f} frames, which are too many for one answer; request "
            "fewer steps.",
            code="search-too-large",
        )


def _steps_of(searchables: Sequence[Searchable], request: SearchRequest) -> tuple[Step, ...]:
    from marey_motion.modelling.search.steps import Step

    return tuple(
        Step(one.usable.primitive, asked.constraints, one.standard_joints)
        for one, asked in zip(searchables, request.asked_steps, strict=True)
    )


def _invalid(request: SearchRequest, error: Any) -> InvalidProblem:
    """Convert an error of the search to an `InvalidProblem` with a JSON Pointer to the constraint that caused it."""
    where = str(error.where or "")
    if not request.steps:
        where = where.removeprefix("steps[0]").removeprefix(".")
    pointer = "".join(f"/{part}" for part in where.replace("[", ".").replace("]", "").split(".") if part)
    problem = FieldError(pointer=pointer, code=error.code, detail=error.message)
    return InvalidProblem(str(error.message), code=error.code, errors=[problem])


# -- answers -----------------------------------------------------------------------------------------------------------


def answer_of(
    result: SearchResult, searchables: Sequence[Searchable], found: Sequence[FoundSearchable], request: SearchRequest
) -> dict[str, Any]:
    """Return the result of a search as a document."""
    from marey_motion.documents import clip_to_document

    errors = _errors(result, request)
    motion = clip_to_document(result.clip, searchables[0].usable.skeleton) if request.motion else None
    answer = SearchAnswer(
        steps=tuple(_found_step(result, number, one, found[number]) for number, one in enumerate(searchables)),
        errors=errors,
        reached=all(one.reached for one in errors),
        out_of_reach=tuple(place for place, one in enumerate(errors) if (one.error_cm or 0.0) > FAR_CM),
        iterations=0 if result.sequel.refined is None else result.sequel.refined.iterations,
        motion=motion,
    )
    return answer.model_dump(by_alias=True, exclude_none=True)


def file_of(
    result: SearchResult, found: Sequence[FoundSearchable], file_format: MotionFormat, unit: str
) -> ComputedFile:
    """Return a file with the motions of all steps. Raises `InvalidProblem` if the format cannot represent them."""
    from marey_motion.errors import MotionError
    from marey_motion.exporting import write_clip_file

    try:
        file = write_clip_file(result.clip, file_format, unit=unit)
    except MotionError as error:
        raise InvalidProblem(str(error), code="cannot-be-exported") from error
    name = " ".join(dict.fromkeys(one.model.name for one in found))
    return ComputedFile(name=f"{name} found{file.suffix}", media_type=file.media_type, data=file.data)


def _errors(result: SearchResult, request: SearchRequest) -> tuple[ConstraintError, ...]:
    errors = []
    for number, step in enumerate(request.asked_steps):
        refined, sampled = result.sequel.measured.errors[number], result.sequel.sampled.errors[number]
        for place, constraint in enumerate(step.constraints):
            unit = UNITS[constraint.type]
            finished = None if result.finished is None else result.finished.errors.get((number, place))
            error = _in_unit(float(refined[place]), unit)
            left = error if finished is None else _in_unit(finished, unit)
            errors.append(
                ConstraintError(
                    step=number,
                    constraint=place,
                    type=constraint.type,
                    joint=getattr(constraint, "joint", None),
                    searched_error=_in_unit(float(sampled[place]), unit),
                    finished_error=None if finished is None else left,
                    reached=left <= _tolerance(constraint, unit),
                    **{f"error_{unit}": error},
                )
            )
    return tuple(errors)


def _tolerance(constraint: SearchConstraint, unit: str) -> float:
    """Return the tolerance of a constraint in the unit of its error: cm, degrees or seconds."""
    if isinstance(constraint, JointPositionConstraint | RootPositionConstraint):
        return constraint.tolerance_m / CM
    return float(getattr(constraint, f"tolerance_{unit}"))


def _in_unit(value: float, unit: str) -> float:
    return {"cm": value / CM, "deg": degrees(value), "s": value}[unit]


def _found_step(result: SearchResult, number: int, one: Searchable, found: FoundSearchable) -> FoundStep:
    sequel, primitive = result.sequel, one.usable.primitive
    latent = sequel.latents[number][None]
    likelihood = float(primitive.log_density(latent)[0])
    known = one.log_likelihoods
    placement = sequel.measured.placements[number]
    jumps = sequel.measured.jumps_m[number - 1] / CM if number else ()
    return FoundStep(
        model=RevisionRef(item=found.model.item, revision=found.model.part.revision),
        tree="stored" if one.stored else "drawn",
        latent=tuple(latent[0].tolist()),
        log_likelihood=likelihood,
        likelihood_percentile=100.0 * bisect_left(known, likelihood) / len(known) if known else None,
        duration_s=float(primitive.durations_s(latent)[0]),
        placement=StartPlacement(x=placement.x, z=placement.z, heading_deg=degrees(placement.heading_rad)),
        jumps_cm=dict(zip(("pelvis", *sequel.joints), map(float, jumps), strict=False)),
        evaluations=sequel.searched[number].evaluations,
    )


def placement_of(start: StartPlacement) -> Placement:
    """Return the `Placement` that moves canonical coordinates to a start position and heading in the world."""
    from marey_motion.alignment.aligned import Placement

    return Placement(radians(start.heading_deg), start.x, start.z)

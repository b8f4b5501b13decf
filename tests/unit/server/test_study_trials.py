"""Times of trials and repeated requests, compared with a model; the test sets the clock."""

from __future__ import annotations

import random
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import pytest
from tests.support.database_fixtures import AdjustableClock
from tests.support.present import present
from tests.support.store_fixtures import Lab, declared
from tests.support.tiers import steps

from marey_schemas.documents.studies import StudyDocument
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.studies.conducting import JudgingParticipant, StudyLinksCreate
from marey_schemas.studies.participation import ParticipationCreate, TrialAnswer, TrialStep
from marey_server.access.principal import ANONYMOUS, Principal
from marey_server.errors import ConflictProblem, ForbiddenProblem, NotFoundProblem
from marey_server.motions.studies import draw_plans
from marey_server.store import items
from marey_server.store.credentials import sign_ins, tokens
from marey_server.store.database.connections import Database
from marey_server.store.studies import conducting, judgements, participants, trials
from marey_server.store.studies.trials import GRACE_US, MOST_TIMEOUTS

pytestmark = pytest.mark.every_database

PARTICIPANTS = declared("POST", "/projects/{project}/{kind}/{item}/participants")
JUDGEMENTS = declared("GET", "/projects/{project}/{kind}/{item}/judgements")
SECONDS = 10.0


def design(lab: Lab, **changes: Any) -> str:
    """Create six clips and a study of them; return the id of the study."""
    skeleton = lab.add_skeleton()
    clips = [lab.add_clip(skeleton, f"walk {number}", seed=number) for number in range(6)]
    motions = [{"clip": {"item": clip.id, "revision": 1}} for clip in clips]
    tree = {"title": "Walks", "consent_text": "Yes.", "motions": motions, "trials": 9, "seconds": SECONDS, **changes}
    study = StudyDocument.model_validate(tree).model_dump(mode="json", by_alias=True)
    made = lab.write(items.create_item, "lab", Kind.STUDY, ItemCreate(name="walks", parts={"study": study}))
    identity: str = made.id
    return identity


def take_part(lab: Lab, study: str) -> Principal:
    """Create a link, exchange it, and return the participant."""
    request = StudyLinksCreate()
    place = ("lab", Kind.STUDY, study)
    planned = lab.read(conducting.plan_links, *place, request, required=PARTICIPANTS)
    plans = draw_plans(planned, 1)
    made = lab.write(conducting.create_links, *place, request, planned, plans, required=PARTICIPANTS)
    code = made.links[0].code
    body = ParticipationCreate.model_validate({"code": code, "key": "a" * 64, "consent": True})
    attempt = participants.try_of(code, "10.0.0.1", 10)
    lab.database.write(ANONYMOUS, sign_ins.count, attempt)
    begun = lab.database.write(ANONYMOUS, participants.begin, body, attempt)
    return lab.database.read(ANONYMOUS, tokens.resolve_token, begun.token)


def judged(lab: Lab, study: str) -> JudgingParticipant:
    page = lab.read(
        judgements.list_judgements, "lab", Kind.STUDY, study, revision=1, cursor=None, limit=50, required=JUDGEMENTS
    )
    one: JudgingParticipant = page.items[0]
    return one


@dataclass
class Model:
    """Expected trials of a participant."""

    answered: int = 0
    number: int = 0
    clips: tuple[int, ...] = ()
    opened_s: float = 0.0
    is_open: bool = False
    outcomes: dict[int, tuple[int, int] | None] = field(default_factory=dict)


@pytest.fixture
def stopped(clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch) -> AdjustableClock:
    """Clock that moves only when the test advances it, because the machine may be slow."""
    begin_us = time.time_ns() // 1000
    monkeypatch.setattr(AdjustableClock, "now_us", lambda self, _connection: begin_us + self._ahead_us)
    return clock


def test_trials_follow_the_clock_and_repeated_requests_change_nothing(lab: Lab, stopped: AdjustableClock) -> None:
    study = design(lab)
    who, draw, model, now_s = take_part(lab, study), random.Random(7), Model(), 0.0
    for _ in range(steps(60)):
        step_s = draw.choice([0.5, 4.0, 9.0, 11.0, 13.0])
        stopped.advance(step_s)
        now_s += step_s
        late_s = now_s - model.opened_s - SECONDS
        if draw.random() < 0.5:
            step: TrialStep = lab.database.write(who, trials.open_trial)
            if model.is_open and late_s >= 0:
                model.outcomes[model.number], model.is_open = None, False
            if step.trial is None:
                assert model.answered == 9
                continue
            if model.is_open:
                assert (step.trial.number, step.trial.clips) == (model.number, model.clips), "the same trial again"
            else:
                assert step.trial.number == model.number + 1
                model.number, model.clips, model.opened_s = step.trial.number, step.trial.clips, now_s
                model.is_open = True
            assert len(set(step.trial.clips)) == 4
            assert 0 < step.trial.seconds_left <= SECONDS
        elif model.number:
            number = draw.randint(1, model.number)
            chosen = draw.choice([(0, 1), (3, 2), (1, 3)])
            if number == model.number and model.is_open:
                in_time = late_s * 1e6 <= GRACE_US
                model.outcomes[number] = (min(chosen), max(chosen)) if in_time else None
                model.answered, model.is_open = model.answered + in_time, False
            outcome = lab.database.write(who, trials.answer_trial, number, TrialAnswer(chosen=chosen))
            assert (outcome.chosen, outcome.answered) == (model.outcomes[number], model.answered)
    one = judged(lab, study)
    assert {trial.number: trial.chosen for trial in one.trials} == model.outcomes
    assert [trial.index for trial in one.trials if trial.chosen] == list(range(model.answered))
    assert one.finished is (model.answered == 9)


def test_every_motion_is_shown_equally_often_and_a_timeout_is_not_counted(lab: Lab, clock: AdjustableClock) -> None:
    study = design(lab, seed=5)
    who = take_part(lab, study)
    first = lab.database.write(who, trials.open_trial).trial
    clock.advance(SECONDS + 0.1)
    second = lab.database.write(who, trials.open_trial)
    assert (present(second.trial).number, second.remaining) == (present(first).number + 1, 9)
    assert present(second.trial).clips != present(first).clips, "a new random set"
    while (step := lab.database.write(who, trials.open_trial)).trial is not None:
        lab.database.write(who, trials.answer_trial, present(step.trial).number, TrialAnswer(chosen=(0, 1)))
    one = judged(lab, study)
    planned = Counter(motion for trial in one.trials if trial.index or trial.number == 1 for motion in trial.shown)
    assert set(planned.values()) == {6}
    assert [trial.timeouts_before for trial in one.trials] == [0, 1, *[0] * 8]
    assert one.trials[0].latency_s is None


def test_a_participant_who_went_away_does_not_fill_the_database(
    lab: Lab, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "MOST_TIMEOUTS", 3)
    assert MOST_TIMEOUTS > 3
    study = design(lab)
    who = take_part(lab, study)
    for _ in range(3):
        lab.database.write(who, trials.open_trial)
        clock.advance(SECONDS + 1)
    for _ in range(2):
        with pytest.raises(ConflictProblem, match="passed without an answer"):
            lab.database.write(who, trials.open_trial)


def test_trials_survive_the_end_of_the_server_between_any_two_requests(
    lab: Lab, clock: AdjustableClock, reopened: Any
) -> None:
    study = design(lab)
    who = take_part(lab, study)
    for index in range(9):
        step = reopened().write(who, trials.open_trial)
        assert reopened().write(who, trials.open_trial).trial.clips == step.trial.clips
        for _ in range(2):
            outcome = reopened().write(who, trials.answer_trial, step.trial.number, TrialAnswer(chosen=(1, 2)))
            assert outcome.answered == index + 1
    assert judged(lab, study).finished


@pytest.fixture
def reopened(database: Database) -> Any:
    """Function that returns the database with all of its connections closed, as a server finds it at its start."""

    def reopen() -> Database:
        database.engine.dispose()
        return database

    return reopen


def test_only_an_attempt_whose_input_is_the_study_reads_judgements(lab: Lab) -> None:
    study = design(lab)
    take_part(lab, study)
    other = Principal("attempt", scopes=("read",), job_id="job_of_nobody", fence=1)
    place: dict[str, Any] = {"revision": 1, "cursor": None, "limit": 50}
    for job, fence in (("job_of_nobody", 1), ("job_of_somebody", 1)):
        with pytest.raises(NotFoundProblem):
            lab.database.read(other, judgements.list_for_attempt, job, fence, study, **place)
    with pytest.raises(ForbiddenProblem):
        lab.read(judgements.list_judgements, "lab", Kind.STUDY, study, **place, who=lab.reader, required=JUDGEMENTS)

"""Consents in the queue: clips that a worker must leave out, users who may allow them, and results that are shared."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import pytest
from tests.support.queue_desk import KINDS, Desk
from tests.support.store_fixtures import WRITE, motion_tree, requiring, skeleton_tree

from marey_schemas.access import MemberChange, Role, UserCreate
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_kinds import EXPORT, RETARGET
from marey_schemas.queue.jobs import JobCreate
from marey_schemas.queue.pipelines import PipelineCreate
from marey_schemas.queue.worker_protocol import Lease, StagedOutput
from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import ForbiddenProblem
from marey_server.store import events, items, members, users
from marey_server.store.database.clock import datetime_of
from marey_server.store.items.consents import EndedConsent, find_ended_consents
from marey_server.store.items.drafts import Draft
from marey_server.store.jobs import exports, retrying, submission
from marey_server.store.transaction import Transaction

DAY_S = 86_400
ALLOWED = {"allow_expired_consent": True, "consent_reason": "The estate has agreed by letter."}
SUBMIT = requiring(WRITE, submission.submit)


def day(desk: Desk, ahead: int) -> str:
    """Return the day `ahead` days after the present day of the database's clock."""
    now_us = desk.database.read(SYSTEM, lambda tx: tx.now_us)
    return datetime_of(now_us + ahead * DAY_S * 1_000_000).date().isoformat()


def info(until: str | None) -> dict[str, Any]:
    return {"schema": "marey/clip-info@1"} | ({} if until is None else {"consent_until": until})


def add_clips(desk: Desk, **until: str | None) -> dict[str, str]:
    """Create clips by name, with the last days of their consents; return their ids."""
    skeleton = Draft("rig", Kind.SKELETON, "rig", {"hierarchy": skeleton_tree()}, collection="rigs")
    motion = motion_tree({"output": "rig"})
    drafts = [
        Draft(name, Kind.CLIP, name, {"motion": motion, "info": info(last)}, collection="walks")
        for name, last in until.items()
    ]
    made = desk.publish(skeleton, *drafts)[1:]
    return dict(zip(until, (one.item for one in made), strict=True))


def set_consent(desk: Desk, clip: str, until: str | None) -> None:
    desk.database.write(desk.user, items.put_part, "lab", Kind.CLIP, clip, "info", info(until), expected_rev=None)


def export(desk: Desk, clips: Any = None, **params: Any) -> str:
    return desk.submit("export", inputs={"clips": clips or {"collection": "walks"}}, params=params)


def ended_in(lease: Lease) -> dict[str, str]:
    return {pin.name: pin.consent_ended for pin in lease.inputs["clips"] if pin.consent_ended is not None}


def complete(desk: Desk, lease: Lease) -> None:
    """Complete an export as the worker does, without a file."""
    ended = [pin.item for pin in lease.inputs["clips"] if pin.consent_ended is not None]
    desk.complete(lease, result={"clips": 0, "consent_ended": ended})


def overrides(desk: Desk) -> list[Any]:
    desk.database.write(SYSTEM, events.number_events)
    found = desk.database.read(desk.user, events.list_events, "lab", limit=1000).items
    return [one for one in found if one.kind == "consent.overridden"]


def test_a_worker_learns_at_the_claim_which_consents_have_ended(desk: Desk) -> None:
    add_clips(desk, gone=day(desk, -1), last=day(desk, 0), later=day(desk, 1), open=None)
    export(desk)
    yesterday = day(desk, -1)
    assert ended_in(desk.claim()) == {"gone": yesterday}


def test_the_day_of_the_claim_counts_and_not_that_of_the_submission(desk: Desk) -> None:
    until = day(desk, 0)
    add_clips(desk, last=until, open=None)
    export(desk)
    desk.clock.advance(DAY_S)
    assert ended_in(desk.claim()) == {"last": until}


def test_the_newest_record_counts_for_every_revision(desk: Desk) -> None:
    clips = add_clips(desk, withdrawn=None, extended=day(desk, -9))
    set_consent(desk, clips["withdrawn"], day(desk, -1))
    set_consent(desk, clips["extended"], day(desk, 9))
    export(desk, [{"item": clip, "revision": 1} for clip in clips.values()])
    assert ended_in(desk.claim()) == {"withdrawn": day(desk, -1)}


def test_other_kinds_of_jobs_are_not_told_and_read_every_clip(desk: Desk) -> None:
    add_clips(desk, gone=day(desk, -1))
    desk.submit("retarget", inputs={"clips": {"collection": "walks"}, "skeleton": {"collection": "rigs"}}, into="out")
    assert ended_in(desk.claim()) == {}


# -- results that are shared -------------------------------------------------------------------------------------------


def test_one_query_finds_the_ended_consents_of_all_jobs_of_a_claim(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    yesterday = day(desk, -1)
    clips = add_clips(desk, gone=yesterday, here=day(desk, 1))
    asked: list[set[str]] = []

    def noted(tx: Transaction, item_ids: Iterable[str]) -> dict[str, EndedConsent]:
        asked.append(wanted := set(item_ids))
        return find_ended_consents(tx, wanted)

    monkeypatch.setattr(exports, "find_ended_consents", noted)
    export(desk, [{"item": clips["gone"]}])
    export(desk, [{"item": clips["here"]}])
    desk.submit("retarget", inputs={"clips": [{"item": clips["gone"]}], "skeleton": {"collection": "rigs"}}, into="out")
    asked.clear()
    leases = desk.claim_many(3)
    assert [(lease.kind, ended_in(lease)) for lease in leases] == [
        ("export", {"gone": yesterday}), ("export", {}), ("retarget", {})
    ]  # fmt: skip
    assert asked == [set(clips.values())]


def test_inputs_that_are_no_items_are_unchanged_beside_a_job_with_an_ended_consent(desk: Desk) -> None:
    clip = add_clips(desk, gone=day(desk, -1))["gone"]
    other = {"clips": [{"output": "made"}]}
    jobs = [("export", {"clips": [{"item": clip}]}), ("export", other)]
    first, second = desk.database.read(SYSTEM, exports.lease_inputs, jobs)
    assert first == {"clips": [{"item": clip, "consent_ended": day(desk, -1)}]}
    assert second == other


def test_a_result_is_shared_until_a_consent_ends(desk: Desk) -> None:
    add_clips(desk, last=day(desk, 0), open=None)
    export(desk)
    complete(desk, desk.claim())
    assert desk.job(export(desk)).cached_from is not None
    desk.clock.advance(DAY_S)
    again = export(desk)
    assert (desk.state(again), desk.job(again).cached_from) == ("queued", None)
    lease = desk.claim()
    assert (lease.job, list(ended_in(lease))) == (again, ["last"])
    complete(desk, lease)
    assert desk.job(export(desk)).cached_from == again


def test_a_result_is_not_shared_by_a_job_that_waited_over_midnight(desk: Desk) -> None:
    add_clips(desk, last=day(desk, 0), open=None)
    export(desk)
    complete(desk, desk.claim())
    first = desk.submit("errand")
    waiting = desk.submit("export", inputs={"clips": {"collection": "walks"}}, after=[first])
    desk.clock.advance(DAY_S)
    desk.complete(desk.claim(kinds=("errand",)))
    assert desk.state(waiting) == "queued"
    assert list(ended_in(desk.claim())) == ["last"]


def test_a_refused_clip_is_exported_again_once_a_later_day_is_recorded(desk: Desk) -> None:
    clips = add_clips(desk, extended=day(desk, -1), open=None)
    wanted = [{"item": clip, "revision": 1} for clip in clips.values()]
    export(desk, wanted)
    complete(desk, desk.claim())
    set_consent(desk, clips["extended"], day(desk, 9))
    again = export(desk, wanted)
    assert desk.state(again) == "queued"
    assert ended_in(desk.claim()) == {}


def test_an_export_that_was_allowed_serves_nobody_who_may_not_allow_it(desk: Desk) -> None:
    add_clips(desk, gone=day(desk, -1), open=None)
    export(desk, **ALLOWED)
    complete(desk, desk.claim())
    assert desk.job(export(desk)).cached_from is None
    assert desk.job(export(desk, **ALLOWED)).cached_from is not None


# -- who may allow it --------------------------------------------------------------------------------------------------


def member(desk: Desk, role: Role) -> Principal:
    """Add a user with a role to the project, and return the user."""
    made = desk.database.write(SYSTEM, users.create_user, UserCreate(name=role.value))
    desk.database.write(desk.user, members.put_member, "lab", role.value, MemberChange(role=role))
    return Principal("user", made.id, role.value, scopes=desk.user.scopes)


def request(clips: Any = None, **params: Any) -> JobCreate:
    return JobCreate(kind="export", inputs={"clips": clips or {"collection": "walks"}}, params=params)


def test_maintainers_allow_an_export_and_an_event_names_the_clips_and_the_reason(desk: Desk) -> None:
    clips = add_clips(desk, gone=day(desk, -1), open=None)
    maintainer = member(desk, Role.MAINTAINER)
    (job,) = desk.database.write(maintainer, SUBMIT, "lab", [request(**ALLOWED)])
    (event,) = overrides(desk)
    assert (event.subject, event.actor) == (job.id, "maintainer")
    assert event.body == {
        "reason": ALLOWED["consent_reason"],
        "clips": [{"item": clips["gone"], "path": "walks/gone", "consent_until": day(desk, -1)}],
        "count": 1,
    }


def test_contributors_cannot_allow_an_export_and_no_job_is_made(desk: Desk) -> None:
    add_clips(desk, gone=day(desk, -1))
    contributor = member(desk, Role.CONTRIBUTOR)
    with pytest.raises(ForbiddenProblem, match="at least the role maintainer") as refused:
        desk.database.write(contributor, SUBMIT, "lab", [request(), request(**ALLOWED)])
    assert refused.value.error_code == "insufficient-role"
    assert (overrides(desk), desk.claim_many()) == ([], [])


def test_a_step_of_a_pipeline_is_no_way_around_the_role(desk: Desk) -> None:
    add_clips(desk, gone=day(desk, -1))
    contributor = member(desk, Role.CONTRIBUTOR)
    step = {"kind": "export", "inputs": {"clips": {"collection": "walks"}}, "params": ALLOWED}
    pipeline = PipelineCreate.model_validate({"steps": {"files": step}})
    with pytest.raises(ForbiddenProblem, match="at least the role maintainer"):
        desk.database.write(contributor, requiring(WRITE, submission.submit_pipeline), "lab", pipeline)


def test_a_retry_needs_the_role_again_and_is_recorded_again(desk: Desk) -> None:
    add_clips(desk, gone=day(desk, -1))
    author = member(desk, Role.MAINTAINER)
    (job,) = desk.database.write(author, SUBMIT, "lab", [request(**ALLOWED)])
    desk.cancel(job.id)
    desk.database.write(desk.user, members.put_member, "lab", "maintainer", MemberChange(role=Role.CONTRIBUTOR))
    with pytest.raises(ForbiddenProblem, match="at least the role maintainer"):
        desk.database.write(author, requiring(WRITE, retrying.retry_job), job.id)
    again = desk.database.write(desk.user, retrying.retry_job, job.id)
    assert [(one.subject, one.body["count"]) for one in overrides(desk)] == [(job.id, 1), (again.id, 1)]


def test_late_inputs_are_judged_when_they_are_known(desk: Desk) -> None:
    clips = add_clips(desk, gone=day(desk, -1))
    maker = desk.submit(
        "edit", inputs={"clips": {"item": clips["gone"]}}, params={"commands": [{"command": "mirror"}]}, into="made"
    )
    desk.submit("export", inputs={"clips": {"job": maker}}, params=ALLOWED)
    desk.submit("export", inputs={"clips": {"job": maker}})
    assert [one.body["count"] for one in overrides(desk)] == [0]
    lease = desk.claim()
    (source,) = lease.inputs["clips"]
    made = StagedOutput(
        name="made", kind=Kind.CLIP, item_name="made",
        parts={"motion": motion_tree(skeleton_of(desk, source.item)), "info": info(day(desk, -1))},
    )  # fmt: skip
    desk.stage_outputs(lease, made)
    desk.complete(lease)
    assert [ended_in(one) for one in desk.claim_many()] == [{"made": day(desk, -1)}] * 2


def skeleton_of(desk: Desk, clip: str) -> dict[str, Any]:
    motion = desk.database.read(desk.user, items.read_part, "lab", Kind.CLIP, clip, "motion", arrays="none")
    return dict(motion.tree["skeleton"])


def test_a_kind_that_exports_takes_the_permission_among_its_parameters() -> None:
    with pytest.raises(ValueError, match="must extend ConsentOverride"):
        replace(RETARGET, exports="clips")
    with pytest.raises(ValueError, match="must name inputs of the kind"):
        replace(EXPORT, exports="takes")
    assert [kind.name for kind in KINDS.values() if kind.exports] == ["export", "script"]

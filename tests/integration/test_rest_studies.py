"""Studies over HTTP: links, consent, trials, withdrawal, and the rights to see the answers of participants."""

from __future__ import annotations

import logging
from collections import Counter
from itertools import chain, combinations
from typing import Any

import httpx
import numpy as np
import pytest
from scipy.stats import spearmanr
from tests.support.rest_server import Server
from tests.support.studying import (
    Participant,
    choice_by,
    finish_analysis,
    grouped_differences,
    make_links,
    make_study,
)

from marey_motion.perception.judging import Judgements, difference_table, triangle_violations
from marey_motion.perception.ordering import order_motions
from marey_schemas.access import Role

NEVER = "mareystudy_" + "0" * 12 + "_" + "0" * 64


def refusal(answer: httpx.Response) -> tuple[int, str, str]:
    return answer.status_code, answer.json()["code"], answer.json()["detail"]


def test_a_participant_takes_part_from_the_link_to_the_last_trial(server: Server, owner: httpx.Client) -> None:
    study = make_study(owner, 8, trials=6, seed=3)
    [code] = make_links(owner, study)
    guest = server.client()
    welcome = guest.post("/participation/link", json={"code": code})
    assert welcome.json() == {
        "title": "Walks", "consent_text": "I take part.", "clips": 8, "trials": 6, "shown": 4, "seconds": 10.0,
    }  # fmt: skip
    body = {"code": code, "key": "a" * 64, "consent": True}
    made = [guest.post("/participation", json=body) for _ in range(2)]
    assert [one.status_code for one in made] == [201, 201]
    assert made[0].json() == made[1].json(), "a lost answer is repeated"
    assert made[0].headers["Cache-Control"] == "no-store"
    other = guest.post("/participation", json={**body, "key": "b" * 64})
    unknown = guest.post("/participation", json={**body, "code": NEVER})
    assert refusal(other) == refusal(unknown) == refusal(guest.post("/participation/link", json={"code": NEVER}))
    assert refusal(other)[:2] == (404, "study-link-invalid")
    someone = Participant(server.client(made[0].json()["token"]))

    seen: list[list[int]] = []
    for index in range(6):
        step, again = someone.open(), someone.open()
        assert again["trial"]["clips"] == step["trial"]["clips"], "a reload shows the same trial"
        assert (step["answered"], step["remaining"], step["trial"]["number"]) == (index, 6 - index, index + 1)
        seen.append(step["trial"]["clips"])
        first = someone.answer(index + 1, (2, 1), client_fps=59.5)
        assert first["chosen"] == [1, 2]
        assert someone.answer(index + 1, (0, 3)) == first, "a double click changes nothing"
    assert someone.open() == {"finished": True, "answered": 6, "remaining": 0, "trial": None}
    assert Counter(chain.from_iterable(seen)) == dict.fromkeys(range(8), 3), "equally often"
    assert someone.client.get("/participation").json()["finished"] is True

    [judged] = owner.get(f"/projects/lab/studies/{study}/judgements", params={"revision": 1}).json()["items"]
    assert (judged["participant"], judged["finished"]) == ("p1", True)
    assert [one["shown"] for one in judged["trials"]] == seen
    assert all(one["chosen"] == [1, 2] and 0 <= one["latency_s"] < 10 for one in judged["trials"])
    assert {(one["seed"], one["client_fps"], one["timeouts_before"]) for one in judged["trials"]} == {(3, 59.5, 0)}


def test_the_same_seed_draws_the_same_trials_however_the_links_are_made(server: Server, owner: httpx.Client) -> None:
    study = make_study(owner, 21)
    codes = [*make_links(owner, study, 2), *make_links(owner, study, 1)]
    together = make_links(owner, copy_of(owner, study), 3)
    for one, other in zip(codes, together, strict=True):
        first, second = (Participant.begin(server.client, code).open() for code in (one, other))
        assert first["trial"]["clips"] == second["trial"]["clips"]


def test_differences_count_the_answers_so_far_and_forget_those_who_withdraw(
    server: Server, owner: httpx.Client
) -> None:
    study = make_study(owner, 4, trials=2)
    address = f"/projects/lab/studies/{study}/differences"
    empty = owner.get(address, params={"revision": 1}).json()
    assert (empty["trials"], empty["order"], empty["noise"], empty["shown"]) == (0, None, None, [[0] * 4] * 4)
    assert empty["differences"][0] == [0.0, None, None, None]
    first, second = (Participant.begin(server.client, code) for code in make_links(owner, study, 2))
    by_size = choice_by(np.abs(np.subtract.outer([0, 1, 5, 9], [0, 1, 5, 9])) / 9, 1e-6, seed=1)
    for someone in (first, second):
        someone.answer_all(by_size)
    found = owner.get(address, params={"revision": 1}).json()
    assert (found["revision"], found["participants"], found["trials"]) == (1, 2, 4)
    assert (found["shown"][0][1], found["chosen"][0][1], found["chosen"][1][2]) == (4, 4, 0)
    assert found["differences"][0] == [0.0, 0.0, 1.0, 1.0]
    assert sorted(found["order"]) == [0, 1, 2, 3]
    assert abs(found["order"].index(0) - found["order"].index(1)) == 1, "the two that are alike are neighbours"
    assert first.client.delete("/participation").status_code == 204
    assert owner.get(address, params={"revision": 1}).json()["trials"] == 2
    assert refusal(owner.get(address, params={"revision": 2}))[0] == 404
    assert owner.get(address).status_code == 400, "the revision is not named"


def test_readers_get_the_files_of_an_analysis_which_browsers_show_without_scripts(
    server: Server, owner: httpx.Client, worker: httpx.Client
) -> None:
    job = finish_analysis(owner, worker, make_study(owner, 7, trials=2))
    reader, stranger = (server.client(server.make_user(name)) for name in ("rita", "sam"))
    assert owner.put("/projects/lab/members/rita", json={"role": "reader"}).is_success
    files = f"/projects/lab/jobs/{job}/files"
    report = reader.get(f"{files}/report")
    assert (report.status_code, report.headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert "Order and groups" in report.text
    made = owner.get(f"/jobs/{job}").json()
    for fact in (f"lab on {server.address}", made["author"], f"{made['finished_at'][:10]} "):
        assert f"<dd>{fact}" in report.text
    policy = report.headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert policy.endswith("; sandbox")
    again = reader.get(f"{files}/report", headers={"If-None-Match": report.headers["ETag"]})
    assert (again.status_code, again.headers["Cache-Control"]) == (304, "private, no-cache")
    document = reader.get(f"{files}/document")
    assert (document.json()["schema"], document.headers["Content-Type"]) == (
        "marey/study-analysis@1", "application/json",
    )  # fmt: skip
    assert reader.get(f"{files}/fitted").json()["origin"] == "fitted"
    assert refusal(reader.get(f"{files}/participants"))[1:] == (
        "no-file", "The result of the job has no file 'participants'; it has document, fitted, report.",
    )  # fmt: skip
    assert owner.post("/projects", json={"name": "other"}).is_success
    assert refusal(owner.get(f"/projects/other/jobs/{job}/files/report"))[:2] == (404, "no-job")
    assert refusal(stranger.get(f"{files}/report"))[0] == 404
    assert refusal(server.client().get(f"{files}/report"))[0] in (401, 404)


def copy_of(owner: httpx.Client, study: str) -> str:
    design = owner.get(f"/projects/lab/studies/{study}/parts/study").json()
    made: str = owner.post("/projects/lab/studies", json={"name": "again", "parts": {"study": design}}).json()["id"]
    return made


def test_a_participant_reads_the_motions_of_the_study_and_nothing_else(server: Server, owner: httpx.Client) -> None:
    study = make_study(owner, 4, trials=1)
    someone = Participant.begin(server.client, make_links(owner, study)[0])
    motions = owner.get(f"/projects/lab/studies/{study}/parts/study").json()["motions"]
    for number, motion in enumerate(motions):
        for accept in ("application/json", "application/msgpack; arrays=blocks"):
            headers = {"Accept": accept}
            whole = owner.get(f"/projects/lab/clips/{motion['clip']['item']}/parts/motion?revision=1", headers=headers)
            shown = someone.client.get(f"/participation/clips/{number}/motion", headers=headers)
            assert (shown.status_code, shown.content) == (200, whole.content)
            assert shown.headers["ETag"] == whole.headers["ETag"]
    assert someone.client.get("/participation/clips/0/hierarchy").json()["schema"] == "marey/skeleton@1"
    for path, code in (("4/motion", "no-clip"), ("0/mapping", "no-part"), ("0/info", "not-found")):
        assert refusal(someone.client.get(f"/participation/clips/{path}"))[:2] == (404, code)
    owner.patch("/projects/lab", json={"visibility": "public"}, headers={"If-Match": "*"})
    for path in ("/projects/lab", f"/projects/lab/studies/{study}", "/me"):
        assert refusal(someone.client.get(path))[:2] == (403, "not-for-participants"), path
    assert refusal(owner.get("/participation"))[:2] == (403, "participants-only")
    assert server.client().get("/participation").status_code == 401


def test_only_people_of_the_study_see_participants_and_readers_see_numbers(server: Server, owner: httpx.Client) -> None:
    study = make_study(owner, 5, trials=2)
    codes = make_links(owner, study, 3)
    Participant.begin(server.client, codes[0]).answer_all(lambda _shown: (0, 1))
    reader, maintainer = (server.client(server.make_user(name)) for name in ("rita", "mia"))
    for name, role in (("rita", Role.READER), ("mia", Role.MAINTAINER)):
        assert owner.put(f"/projects/lab/members/{name}", json={"role": role}).is_success
    base = f"/projects/lab/studies/{study}"
    assert reader.get(f"{base}/progress").json() == {
        "invited": 2, "started": 1, "finished": 1, "withdrawn": 0, "answered": 2, "timeouts": 0,
    }  # fmt: skip
    for path in ("/participants", "/judgements?revision=1", "/differences?revision=1"):
        assert refusal(reader.get(base + path))[:2] == (403, "insufficient-role")
        assert maintainer.get(base + path).status_code == 200
    listed = maintainer.get(f"{base}/participants").json()["items"]
    assert [(one["participant"], one["state"], one["answered"]) for one in listed] == [
        ("p1", "finished", 2), ("p2", "invited", 0), ("p3", "invited", 0),
    ]  # fmt: skip
    assert refusal(owner.get(f"/projects/lab/clips/{study}/participants"))[:2] == (404, "not-a-study")


def test_withdrawal_deletes_what_is_stored_and_ends_the_link(server: Server, owner: httpx.Client) -> None:
    study = make_study(owner, 5, trials=2)
    base = f"/projects/lab/studies/{study}"
    codes = make_links(owner, study, 2)
    people = [Participant.begin(server.client, code) for code in codes]
    for person in people:
        person.answer_all(lambda _shown: (0, 1))
    assert [people[0].client.delete("/participation").status_code for _ in range(2)] == [204, 204]
    second = owner.get(f"{base}/participants").json()["items"][1]["id"]
    assert [owner.delete(f"{base}/participants/{second}").status_code for _ in range(2)] == [204, 204]
    for person, code in zip(people, codes, strict=True):
        for answer in (person.client.get("/participation"), person.client.post("/participation/trials")):
            assert refusal(answer)[:2] == (410, "participation-withdrawn")
        assert server.client().post("/participation/link", json={"code": code}).status_code == 404
    assert owner.get(f"{base}/judgements?revision=1").json()["items"] == []
    assert owner.get(f"{base}/progress").json()["withdrawn"] == 2
    log = owner.get("/projects/lab/audit").json()["items"]
    entries = [(one["kind"], one["actor"], one["body"]) for one in log if one["kind"].startswith("study")]
    assert entries == [
        ("study.withdrawn", "olga", {"by": "conductor"}),
        ("study.withdrawn", None, {"by": "participant"}),
        ("study.invited", "olga", {"count": 2}),
    ]


def test_a_deleted_study_lets_nobody_in(server: Server, owner: httpx.Client) -> None:
    study = make_study(owner, 4, trials=1)
    begun, unused = make_links(owner, study, 2)
    someone = Participant.begin(server.client, begun)
    assert owner.delete(f"/projects/lab/studies/{study}", headers={"If-Match": "*"}).is_success
    assert refusal(someone.client.post("/participation/trials"))[:2] == (410, "study-gone")
    assert server.client().post("/participation/link", json={"code": unused}).status_code == 404
    assert owner.post("/projects/lab/purges", json={"item": study, "kind": "study"}).is_success
    assert refusal(someone.client.get("/participation"))[:2] == (401, "bad-token")


WRONG_ANSWERS: list[dict[str, Any]] = [
    {"chosen": [1, 1]}, {"chosen": [0, 4]}, {"chosen": [0]}, {"chosen": [-1, 2]}, {"chosen": None}, {},
    {"chosen": [0, 1], "client_fps": 0}, {"chosen": [0, 1], "client_fps": 1e9}, {"chosen": [0, 1], "x": 1},
]  # fmt: skip


def test_a_wrong_answer_changes_nothing(server: Server, owner: httpx.Client) -> None:
    someone = Participant.begin(server.client, make_links(owner, make_study(owner, 4, trials=1))[0])
    someone.open()
    for body in WRONG_ANSWERS:
        assert someone.client.put("/participation/trials/1", json=body).status_code == 422, body
        assert someone.open()["answered"] == 0, body
    assert refusal(someone.client.put("/participation/trials/2", json={"chosen": [0, 1]}))[:2] == (404, "no-trial")
    assert someone.open()["answered"] == 0


def test_wrong_designs_and_requests_say_what_to_do(server: Server, owner: httpx.Client) -> None:
    study = make_study(owner, 4)
    design = owner.get(f"/projects/lab/studies/{study}/parts/study").json()
    motions = design["motions"]
    wrong = [
        {"motions": motions[:3]}, {"motions": [*motions[:3], motions[0]]}, {"trials": 0}, {"shown": 5},
        {"seconds": 0}, {"seed": -1}, {"consent_text": " "},
        {"motions": [*motions[:3], {"clip": {"item": motions[0]["clip"]["item"] + "x", "revision": 1}}]},
    ]  # fmt: skip
    for change in wrong:
        answer = owner.post("/projects/lab/studies", json={"name": "bad", "parts": {"study": {**design, **change}}})
        assert answer.status_code == 422, change
        assert "/study" in answer.text, change
    for body in ({"count": 0}, {"count": 101}, {"expires_in_s": 1}):
        assert owner.post(f"/projects/lab/studies/{study}/participants", json=body).status_code == 422
    [code] = make_links(owner, study)
    refused: list[dict[str, Any]] = [{"consent": False}, {"key": "A" * 64}, {"key": "a"}, {"code": "x" * 201}]
    for change in refused:
        request = {"code": code, "key": "a" * 64, "consent": True, **change}
        assert server.client().post("/participation", json=request).status_code == 422


def test_logs_contain_no_codes_tokens_or_participants(
    server: Server, owner: httpx.Client, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.DEBUG):
        [code] = make_links(owner, make_study(owner, 4, trials=1))
        someone = Participant.begin(server.client, code)
        someone.answer_all(lambda _shown: (0, 1))
        someone.client.delete("/participation")
    token = someone.client.headers["Authorization"].removeprefix("Bearer ")
    written = "\n".join(f"{record.getMessage()} {record.__dict__}" for record in caplog.records)
    assert "/participation/trials" in written
    assert not [part for text in (code, token) for part in text.split("_")[1:] if part in written]
    assert "participant_" not in written


@pytest.mark.parametrize("people", [pytest.param(29, marks=pytest.mark.soak), 4])
def test_a_simulated_study_recovers_the_groups(server: Server, owner: httpx.Client, people: int) -> None:
    """The true differences have two groups of 14 and 7 motions; 29 participants are as many as in the paper."""
    true = grouped_differences((14, 7), seed=4)
    study = make_study(owner, 21)
    for number, code in enumerate(make_links(owner, study, people)):
        Participant.begin(server.client, code).answer_all(choice_by(true, 0.05, seed=number))
    answer = owner.get(f"/projects/lab/studies/{study}/judgements", params={"revision": 1}).json()
    trials = [(who, trial) for who, one in enumerate(answer["items"]) for trial in one["trials"]]
    assert len(trials) == 63 * people
    pairs = list(combinations(range(4), 2))
    judgements = Judgements(
        21,
        np.array([who for who, _ in trials]),
        np.array([trial["shown"] for _, trial in trials]),
        np.array([pairs.index(tuple(trial["chosen"])) for _, trial in trials]),
    )
    assert set(np.bincount(judgements.shown.ravel())) == {12 * people}, "each motion equally often"
    table = difference_table(judgements)
    assert 6 * table.chosen.sum() == table.shown.sum()
    assert list(order_motions(table.differences).groups[[0, 20]]) in ([0, 1], [1, 0])
    assert len(set(order_motions(table.differences).groups[:14])) == 1
    assert len(set(order_motions(table.differences).groups[14:])) == 1
    known = np.triu(table.shown, 1) > 0
    assert spearmanr(table.differences[known], true[known]).statistic >= (0.9 if people == 29 else 0.8)
    violated, checked = triangle_violations(table.differences)
    assert violated <= 0.05 * checked


def test_guesses_of_links_are_limited(server: Server, owner: httpx.Client) -> None:
    make_study(owner, 4)
    answers = {server.client().post("/participation/link", json={"code": NEVER}).status_code for _ in range(30)}
    assert answers == {404, 429}

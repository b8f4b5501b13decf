"""A private project with marked contents, one token for each kind of caller, and a valid request for every route."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import update
from tests.support.present import present
from tests.support.rest_server import SCRIPTS_AT, People
from tests.support.who_may import PEOPLE

from marey_schemas.encoding.canonical import document_digest
from marey_server.access.principal import SYSTEM
from marey_server.handlers.catalogue import RESOURCES
from marey_server.http.routes import Route, routes_of
from marey_server.store.tables import job, token
from marey_versions.records import revision_content
from marey_versions.tree.building import build
from marey_versions.tree.chunks import ChunksInMemory

CANARY = "canary-5e0f2b"
ROUTES = tuple(routes_of(RESOURCES))
UNKNOWN_LINK = "mareystudy_aaaaaaaaaaaa_" + "b" * 64
UNKNOWN_CODE = "mareyinvite_aaaaaaaaaaaa_" + "b" * 64
INVENTED = "marey_aaaaaaaaaaaa_" + "b" * 64

HIERARCHY = {"schema": "marey/skeleton@1", "joints": [{"name": CANARY, "parent": -1, "offset": [0, 1, 0]}]}
MOTION = {
    "schema": "marey/motion@1",
    "frame_rate_hz": 30,
    "joints": [CANARY],
    "poses": {"dtype": "<f4", "shape": [1, 7], "data": [[0, 1, 0, 1, 0, 0, 0]]},
}
SECRET_BYTES = f"{CANARY} bytes".encode()
SECRET_DIGEST = f"sha256:{hashlib.sha256(SECRET_BYTES).hexdigest()}"
EMPTY_TREE = build(ChunksInMemory(), ())
OTHER_BYTES = b"bytes of anybody"
OTHER_DIGEST = f"sha256:{hashlib.sha256(OTHER_BYTES).hexdigest()}"
MULTIPART = b"--b\r\nContent-Disposition: form-data; name=files; filename=x.bvh\r\n\r\nno motion\r\n--b--\r\n"

BODIES: dict[str, Any] = {
    "Login": {"name": "nobody", "password": "wrong wrong wrong"},
    "BrowserSignInCreate": {"challenge": "0" * 64},
    "BrowserSessionCreate": {"code": "invented"},
    "BrowserSignInCode": {"code": "invented", "verifier": "v" * 43},
    "IdentityLink": {"subject": "sub-of-nobody", "issuer": "https://login.invalid"},
    "TokenCreate": {"name": "t", "scopes": ["read"]},
    "TokenRotation": {"rotation_id": "r" * 32},
    "UserCreate": {"name": "new-user"},
    "UserChange": {"display_name": "D"},
    "ProjectCreate": {"name": "lab"},  # the name is taken: 409 means that the caller was admitted
    "ProjectChange": {"title": "T"},
    "ProjectQuotaChange": {"items": 10**6, "running_jobs": 1000},
    "QuotaChange": {"items": 10**6},
    "MemberChange": {"role": "reader"},
    "FolderRoleChange": {"role": "contributor"},
    "InvitationCreate": {"role": "reader", "note": CANARY},
    "AccountInvitationCreate": {"project": "lab", "role": "reader", "note": CANARY},
    "InvitationAcceptance": {"code": UNKNOWN_CODE},
    "SignUp": {"code": UNKNOWN_CODE, "name": "newcomer", "password": "correct horse"},
    "ScriptCreate": {
        "name": "new-script",
        "description": CANARY,
        "repository": f"{SCRIPTS_AT}{CANARY}",
        "commit": "c" * 40,
        "argv": ["python", "measure.py", "{output:fields}"],
        "outputs": {"fields": {"kind": "fields"}},
    },
    "ScriptRunCreate": {"message": CANARY},
    "CollectionCreate": {"path": CANARY},
    "CollectionChange": {"path": "elsewhere"},
    "ItemCreate": {"name": CANARY, "collection": CANARY, "parts": {"hierarchy": HIERARCHY}},
    "DatasetCreate": {"name": "another"},
    "RefCreate": {"name": "another", "kind": "tag"},
    "CommitCreate": {"message": "m", "changes": [{"change": "remove", "path": CANARY, "kind": "graph"}]},
    "MergeRequest": {"version": "spare"},
    "PickRequest": {"version": "spare"},
    "RefMove": {"at": "main"},
    "ProtectionRule": {"approvals": 1},
    "ProposalCreate": {"title": CANARY, "source": "spare"},
    "CommentCreate": {"text": CANARY},
    "ReviewCreate": {"verdict": "approve"},
    "CheckReport": {"name": "evaluation", "state": "pending"},
    "ProposalMerge": {"when_green": True},
    "CheckoutRequest": {"version": "spare", "discard": True},
    "ContentsRequest": {"revisions": [OTHER_DIGEST]},
    "ExportCheck": {"contents": [OTHER_DIGEST]},
    "ReceivedRevisions": {
        "revisions": [
            {
                "content": revision_content("skeleton", {"hierarchy": document_digest(HIERARCHY)}),
                "kind": "skeleton",
                "path": "received",
                "parts": {"hierarchy": HIERARCHY},
            }
        ]
    },
    "ReceivedCommit": {
        "tree": EMPTY_TREE,
        "parents": [],
        "author": CANARY,
        "message": "m",
        "at": "2026-11-23T10:00:00.000000Z",
        "changes": [],
    },
    "PartsRequest": {"parts": [{"kind": "clip", "item": "item_of_nobody", "revision": 1, "part": "info"}]},
    "ItemChange": {"name": "renamed"},
    "SkeletonMergeRequest": {"dry_run": True},
    "PurgeRequest": {"collection": "", "preview": True},
    "DatasetPurgeRequest": {"dataset": "deleted", "preview": True},
    "ItemRevert": {"revision": 1},
    "Document": {"schema": "marey/clip-info@1", "comment": CANARY},
    "JobCreate": {"kind": "no-such-kind"},
    "JobBatch": {"jobs": [{"kind": "no-such-kind"}]},
    "ScheduleCreate": {"name": "s", "cron": "0 3 * * *", "job": {"kind": "no-such-kind"}},
    "ScheduleChange": {"description": CANARY},
    "PipelineCreate": {"steps": {"only": {"kind": "no-such-kind"}}},
    "ClaimRequest": {"worker": "w", "kinds": ["no-such-kind"]},
    "BatchCompleteRequest": {"completions": [{"job": "job_x", "fence": 1, "write_id": "12345678"}]},
    "Heartbeat": {},
    "StageRequest": {
        "outputs": [{"name": "o", "kind": "skeleton", "item_name": "s", "parts": {"hierarchy": HIERARCHY}}]
    },
    "CompleteRequest": {"write_id": "12345678"},
    "FailRequest": {"write_id": "12345678", "code": "x"},
    "BlobsQuery": {"digests": [SECRET_DIGEST]},
    "UploadCreate": {"length": 5},
    "CoverageStreamCreate": {"frame_rate_hz": 60},
    "CoverageFrames": {"offset": 0, "ends_take": True},
    "WebhookCreate": {"url": "https://hooks.example.org/marey"},
    "WebhookChange": {"description": CANARY},
    "WebhookRotation": {"grace_s": 60},
    "AnnotationChange": {"commands": [{"command": "clear"}]},
    "AnnotationImport": {"document": {"sections": [{"start_idx": 0, "end_idx": 0}]}},
    "EditPreviewRequest": {"commands": [{"command": "trim", "start": 0, "stop": 1}]},
    "StudyLink": {"code": UNKNOWN_LINK},
    "ParticipationCreate": {"code": UNKNOWN_LINK, "key": "a" * 64, "consent": True},
    "TrialAnswer": {"chosen": [0, 1]},
    "StudyLinksCreate": {"count": 1},
    "SearchRequest": {"constraints": [{"type": "root_heading", "at": "end", "heading_deg": 0}]},
    "SimilarRequest": {"clip": "item_of_nobody", "frames": [0, 1]},
}
"""A body for every request model of the routes. A route with a new model fails in tests until a body is added here."""


_OTHER_THINGS = {
    "/commands": {"kind": "annotations", "item": "{annotation}"},
    "/walk-graph": {"kind": "evaluations", "item": "evaluation_of_nobody"},
    "/samples": {"kind": "models", "item": "model_of_nobody"},
    "/search": {"kind": "models", "item": "model_of_nobody"},
    "{item}/participants": {"kind": "studies", "item": "{study}"},
    "{item}/progress": {"kind": "studies", "item": "{study}"},
    "{item}/judgements": {"kind": "studies", "item": "{study}"},
    "{item}/differences": {"kind": "studies", "item": "{study}"},
    "/participation/clips": {"part": "motion"},
    "{project}/restore": {"project": "gone"},
}
"""Path variables of routes that are not about the clip, by a part of the path."""
_QUERIES = {
    "{item}/export": "?format=original",
    "{item}/difference": "?from=1&to=1",
    "{item}/judgements": "?revision=1",
    "{item}/differences": "?revision=1",
    "judgements/{item}": "?revision=1",
    "explanations/{kind}": "?query=has%20tag",
    "{dataset}/blame": f"?entry={CANARY}&kind=graph",
}
"""Query strings of routes that need one, by the end of the path."""


@dataclass(frozen=True)
class Planned:
    """Valid request of a route: if it is refused, the reason is that the caller lacks the right to send it."""

    method: str
    path: str
    headers: Mapping[str, str]
    content: bytes


@dataclass
class House:
    """A private project with marked contents, one token for each kind of caller, and the ids of the contents."""

    people: People
    tokens: dict[str, str | None]
    variables: dict[str, str]

    def plan(self, route: Route, **changed: str) -> Planned:
        """Return the request of a route; `changed` replaces values of path variables."""
        operation, template = route.operation, route.template
        variables = self.variables | changed
        for piece, values in _OTHER_THINGS.items():
            if piece in template:
                variables |= {name: value.format(**self.variables) for name, value in values.items()}
        if template.endswith("/{kind}") and operation.method == "POST":
            variables["kind"] = "skeletons"
        headers = {} if operation.precondition == "none" else {"If-Match": '"999999.json"'}
        content = b""
        if operation.body is not None:
            name = operation.body.content.__name__
            if name == "Bytes":
                variables["digest"] = OTHER_DIGEST
                content = OTHER_BYTES
                headers |= {"Upload-Offset": "0", "Content-Type": "application/octet-stream"}
            elif name == "Files":
                content = MULTIPART
                headers["Content-Type"] = "multipart/form-data; boundary=b"
            else:
                content = json.dumps(BODIES[name]).encode()
                headers["Content-Type"] = "application/json"
        query = next((query for ending, query in _QUERIES.items() if template.endswith(ending)), "")
        if template.endswith("{project}/{kind}") and operation.method == "GET":
            query = f"?name={CANARY}"  # attempts may only look up names
        return Planned(operation.method, template.replace(":int", "").format(**variables) + query, headers, content)


def build_house(people: People) -> House:
    """Fill a server with users, the project `lab`, items, and jobs, of which one is running and one has ended."""
    tokens = _tokens_of_users(people)
    owner, contributor = people.client(tokens["owner"]), people.client(tokens["contributor"])
    variables = _furnish(owner)
    stream = contributor.post("/projects/lab/coverage-streams", json=BODIES["CoverageStreamCreate"])
    ended, running = (start_attempt(people, tokens, variables["item"]) for _ in range(2))
    tokens |= {"attempt": running["attempt_token"], "ended": ended["attempt_token"]}
    tokens["participant"] = _participant_of(people, owner, variables["study"])
    # The running attempt sends no heartbeats, and requests about it may take longer than a lease.
    tomorrow = (
        update(job).where(job.c.id == running["job"]).values(lease_expires_us=job.c.lease_expires_us + 86_400 * 10**6)
    )
    people.database.write(SYSTEM, lambda tx: tx.execute(tomorrow))
    end = f"/jobs/{ended['job']}/attempts/{ended['fence']}/fail"
    assert people.client(tokens["ended"]).post(end, json={"write_id": "12345678", "code": "x"}).is_success
    for name in ("gone", "elsewhere"):
        assert owner.post("/projects", json={"name": name}).is_success
    assert owner.put("/projects/elsewhere/members/bound", json={"role": "owner"}).is_success
    for name in ("reader", "contributor", "maintainer"):
        assert owner.put(f"/projects/gone/members/{name}", json={"role": name}).is_success
    variables |= {
        "project": "lab", "kind": "clips", "part": "info", "revision": "1", "user": "reader", "job": running["job"],
        "fence": str(running["fence"]), "digest": SECRET_DIGEST, "job_kind": "import", "figure": "offsets",
        "stream": stream.json()["id"], "token": "token_of_nobody", "sign_in": "sign_in_of_nobody",
        "identity": "identity_of_nobody", "upload": "upload_of_nobody", "asset": "file-of-nobody.js",
        "file": "report",
    }  # fmt: skip
    return House(people, tokens, variables)


def _participant_of(people: People, owner: Any, study: str) -> str:
    """Return the token of a participant of a study, who was shown one trial."""
    made = owner.post(f"/projects/lab/studies/{study}/participants", json=BODIES["StudyLinksCreate"])
    body = BODIES["ParticipationCreate"] | {"code": made.json()["links"][0]["code"]}
    token: str = people.client().post("/participation", json=body).json()["token"]
    assert people.client(token).post("/participation/trials").is_success
    return token


def start_attempt(people: People, tokens: Mapping[str, str | None], clip: str) -> dict[str, Any]:
    """As the contributor, submit a job that exports a clip of `lab`; claim an export job, and return its lease."""
    body = {"kind": "export", "inputs": {"clips": [{"item": clip}]}, "cache": "refresh", "priority": 5}
    job = people.client(tokens["contributor"]).post("/projects/lab/jobs", json=body)
    assert job.status_code == 202, job.text
    request = {"worker": "w", "kinds": ["export"], "max": 1}
    lease: dict[str, Any] = people.client(tokens["worker"]).post("/leases", json=request).json()["leases"][0]
    return lease


def _tokens_of_users(people: People) -> dict[str, str | None]:
    users = [person for person in PEOPLE.values() if person.standing in ("user", "refused") and person.name != "owner"]
    tokens: dict[str, str | None] = {"anonymous": None}
    for person in users:
        tokens[person.name] = people.make_user(person.name, administrator=person.administrator, scopes=person.scopes)
    members = {person.name: person.role for person in users if person.role is not None and person.name != "invented"}
    tokens["owner"] = people.make_project("lab", owner="owner", **members)
    tokens["invented"] = INVENTED
    administrator = people.client(tokens["administrator"])
    assert administrator.delete("/users/disabled", headers={"If-Match": "*"}).is_success
    prefix = present(tokens["expired"]).split("_")[1]
    end = update(token).where(token.c.prefix == prefix)
    # A token that expired long ago would be deleted while tests compare the tables.
    people.database.write(SYSTEM, lambda tx: tx.execute(end.values(expires_us=tx.now_us - 1)))
    return tokens


def _furnish(owner: Any) -> dict[str, str]:
    """Create a skeleton, a clip, a blob, an annotation and more in `lab`; return values of path variables by name."""
    etag = owner.get("/projects/lab").headers["ETag"]
    assert owner.patch("/projects/lab", json={"description": CANARY}, headers={"If-Match": etag}).is_success
    assert owner.put(f"/blobs/{SECRET_DIGEST}", content=SECRET_BYTES).is_success
    collection = owner.post("/projects/lab/collections", json={"path": CANARY}).json()["id"]
    body = {"name": CANARY, "collection": CANARY, "parts": {"hierarchy": HIERARCHY}}
    skeleton = owner.post("/projects/lab/skeletons", json=body).json()["id"]
    info = {"schema": "marey/clip-info@1", "comment": CANARY, "source": {"file": SECRET_DIGEST, "file_name": CANARY}}
    motion = {**MOTION, "skeleton": {"item": skeleton, "revision": 1}}
    made = owner.post("/projects/lab/clips", json={"name": CANARY, "parts": {"motion": motion, "info": info}})
    assert made.status_code == 201, made.text
    layer = {"schema": "marey/annotation@1", "clip": {"item": made.json()["id"], "revision": 1}, "layer": CANARY}
    annotation = owner.post("/projects/lab/annotations", json={"name": CANARY, "parts": {"annotation": layer}})
    assert annotation.status_code == 201, annotation.text
    datasets = "/projects/lab/datasets"
    assert owner.post(datasets, json={"name": CANARY, "collection": CANARY}).status_code == 201
    assert owner.post(f"{datasets}/{CANARY}/commits", json={"message": CANARY}).status_code == 201
    assert owner.post(f"{datasets}/{CANARY}/refs", json={"name": "spare", "kind": "tag"}).status_code == 201
    assert owner.post(datasets, json={"name": "deleted"}).status_code == 201
    assert owner.delete(f"{datasets}/deleted", headers={"If-Match": "*"}).is_success
    proposal = f"{datasets}/{CANARY}/proposals"
    assert owner.post(proposal, json=BODIES["ProposalCreate"]).status_code == 201
    assert owner.post(f"{proposal}/1/comments", json=BODIES["CommentCreate"]).status_code == 201
    webhooks = "/projects/lab/webhooks"
    hook = owner.post(webhooks, json={"url": f"https://hooks.invalid/{CANARY}", "description": CANARY}).json()["id"]
    delivery = owner.post(f"{webhooks}/{hook}/test").json()["id"]
    assert owner.patch(f"{webhooks}/{hook}", json={"paused": True}).is_success
    job_of_schedule = {"kind": "evaluate", "inputs": {"clips": {"item": made.json()["id"]}}, "message": CANARY}
    schedule = {"name": "nightly", "cron": "0 0 29 2 *", "job": job_of_schedule, "description": CANARY}
    assert owner.post("/projects/lab/schedules", json=schedule).status_code == 201
    assert owner.post("/projects/lab/scripts", json=BODIES["ScriptCreate"] | {"name": "measure"}).status_code == 201
    motions = [
        {"clip": {"item": owner.post("/projects/lab/clips", json=body).json()["id"], "revision": 1}, "label": CANARY}
        for body in ({"name": f"{CANARY} {number}", "parts": {"motion": motion}} for number in range(4))
    ]
    design = {"schema": "marey/study@1", "title": CANARY, "consent_text": CANARY, "motions": motions}
    study = owner.post("/projects/lab/studies", json={"name": CANARY, "parts": {"study": design}})
    assert study.status_code == 201, study.text
    invitation = owner.post("/projects/lab/invitations", json=BODIES["InvitationCreate"]).json()["id"]
    return {
        "invitation": invitation, "webhook": hook, "delivery": delivery, "schedule": "nightly",
        "script": "measure", "study": study.json()["id"], "participant": "participant_of_nobody", "trial": "1",
        "clip": "0",
        "collection": collection, "item": made.json()["id"], "annotation": annotation.json()["id"], "dataset": CANARY,
        "ref": "spare", "version": "spare", "proposal": "1",
    }  # fmt: skip

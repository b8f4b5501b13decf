"""List of all resources of the server, in the order of the documentation, and the description of the API."""

import hashlib
import json
from importlib.metadata import version

from marey_server.handlers import (
    access,
    annotations,
    audit,
    blobs,
    collections,
    coverage_streams,
    documentation,
    edits,
    events,
    exports,
    folder_roles,
    health,
    identities,
    imports,
    invitations,
    items,
    parts,
    projects,
    purges,
    reports,
    samples,
    uploads,
    webhooks,
)
from marey_server.handlers.browser import pages, sessions
from marey_server.handlers.queue import jobs, leases, pipelines, schedules, scripts
from marey_server.handlers.searching import models, similar
from marey_server.handlers.studies import conducting, participation
from marey_server.handlers.versions import contents, datasets, differences, proposals
from marey_server.http.docs_page import render_page
from marey_server.http.openapi import build_document
from marey_server.http.resource import Resource
from marey_server.http.routes import routes_of
from marey_server.process.services import Description

RESOURCES: tuple[type[Resource], ...] = (
    *access.RESOURCES,
    *identities.RESOURCES,
    *sessions.RESOURCES,
    *projects.RESOURCES,
    *invitations.RESOURCES,
    *collections.RESOURCES,
    *folder_roles.RESOURCES,
    *items.RESOURCES,
    *parts.RESOURCES,
    *purges.RESOURCES,
    *differences.RESOURCES,
    *datasets.RESOURCES,
    *proposals.RESOURCES,
    *contents.RESOURCES,
    *annotations.RESOURCES,
    *edits.RESOURCES,
    *exports.RESOURCES,
    *reports.RESOURCES,
    *samples.RESOURCES,
    *models.RESOURCES,
    *similar.RESOURCES,
    *coverage_streams.RESOURCES,
    *conducting.RESOURCES,
    *participation.RESOURCES,
    *imports.RESOURCES,
    *jobs.RESOURCES,
    *pipelines.RESOURCES,
    *leases.RESOURCES,
    *schedules.RESOURCES,
    *scripts.RESOURCES,
    *blobs.RESOURCES,
    *uploads.RESOURCES,
    *events.RESOURCES,
    *audit.RESOURCES,
    *webhooks.RESOURCES,
    *documentation.RESOURCES,
    *pages.RESOURCES,
    *health.RESOURCES,
)


def describe_api(_order: bytes) -> bytes:
    """Return a packed `Description` of the API. A child process runs this function, because it takes seconds."""
    document = build_document(routes_of(RESOURCES), version("marey"))
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode()
    tag = hashlib.sha256(text).hexdigest()[:16]
    return Description(document=text, page=render_page(document), tag=tag).pack()

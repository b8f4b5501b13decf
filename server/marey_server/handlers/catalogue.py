"""Every resource that the server offers, in the order of the documentation."""

from marey_server.handlers import (
    access,
    blobs,
    collections,
    documentation,
    events,
    health,
    imports,
    items,
    parts,
    projects,
)
from marey_server.handlers.resource import Resource

RESOURCES: tuple[type[Resource], ...] = (
    *access.RESOURCES,
    *projects.RESOURCES,
    *collections.RESOURCES,
    *items.RESOURCES,
    *parts.RESOURCES,
    *imports.RESOURCES,
    *blobs.RESOURCES,
    *events.RESOURCES,
    *documentation.RESOURCES,
    *health.RESOURCES,
)

"""Every resource that the server offers, in the order of the documentation."""

from marey_server.handlers import health
from marey_server.handlers.resource import Resource

RESOURCES: tuple[type[Resource], ...] = (health.Healthz, health.Readyz, health.MetricsPage)

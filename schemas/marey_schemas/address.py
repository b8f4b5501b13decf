"""Default addresses of a server. This module imports nothing, so that the command line starts quickly."""

API = "/api/v1"
"""Prefix of the paths of all resources, except the probes."""

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8460

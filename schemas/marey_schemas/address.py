"""Default address of a server, and names of settings. This module imports nothing, so that commands start quickly."""

API = "/api/v1"
"""Prefix of the paths of the REST API. Other paths, such as those of health checks, do not have this prefix."""

SETTINGS_FILE = "marey.toml"
"""Name of the file with the settings of a server, in its working directory."""
DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8460

SERVER_VARIABLES = ("MAREY_SERVER", "MAREY_URL")
"""Environment variables from which clients and workers read the address of the server; the first that is set is used.

The second variable is the name that earlier releases used.
"""

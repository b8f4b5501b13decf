"""Default address of a server, its files, and names of settings. It imports nothing, so that commands start quickly."""

API = "/api/v1"
"""Prefix of the paths of the REST API. Other paths, such as those of health checks, do not have this prefix."""

SETTINGS_FILE = "marey.toml"
"""Name of the file with the settings of a server, in its working directory."""
DEFAULT_DATA = "marey-data"
"""Data folder of a server, if neither an option nor a setting names one."""
DATABASE_FILE = "marey.db"
"""Name of the SQLite file in the data folder, if no address of a database is set."""
ADMIN_TOKEN_FILE = "admin.token"  # noqa: S105 - the name of a file
"""Name of the file in the data folder with the token of the first administrator, which clients on the machine read."""
DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8460

SERVER_VARIABLES = ("MAREY_SERVER", "MAREY_URL")
"""Environment variables from which clients and workers read the address of the server; the first that is set is used.

The second variable is the name that earlier releases used.
"""

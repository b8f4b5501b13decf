"""Launchers, which start worker processes for a server."""

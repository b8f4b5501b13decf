"""Launchers of workers: beside the server, or on a cluster."""

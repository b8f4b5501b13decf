"""The Marey REST server."""

"""Python SDK and the `marey` command."""

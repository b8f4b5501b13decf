"""Edits: their commands, and requests to preview them."""

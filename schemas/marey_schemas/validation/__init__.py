"""Faults that pydantic found in a document: which of them to report, where they are, and their reasons."""

"""Bridges: exports of dataset versions to folders that other programs read; some of them can be imported again."""

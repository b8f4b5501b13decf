"""Bridges: exports of dataset versions to folders for other programs; some of these folders can be imported again."""

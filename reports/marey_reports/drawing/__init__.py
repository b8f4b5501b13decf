"""Shared drawing code: paper and ink, bodies as lines, figures with their numbers, pages and tables."""

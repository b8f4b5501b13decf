"""Shared drawing code: style of figures, bodies as lines, figures with their numbers, pages and tables."""

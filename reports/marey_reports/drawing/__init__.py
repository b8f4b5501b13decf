"""Shared drawing code: style of figures, bodies drawn as lines, figures with their data, pages and tables."""

"""Bringing motions into step with each other: which frame of one belongs to which frame of another."""

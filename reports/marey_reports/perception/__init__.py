"""Figures of the perceptual metric."""

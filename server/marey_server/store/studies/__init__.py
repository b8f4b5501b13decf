"""Perceptual studies: links, participants, their trials, and their judgements."""

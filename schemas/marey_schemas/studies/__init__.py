"""Requests and answers of perceptual studies, for their participants and for those who carry them out."""

"""Conversion of uploaded files to documents of skeletons, clips and models."""

"""Readers and writers of the documents of the predecessor (Herrmann et al. 2019)."""

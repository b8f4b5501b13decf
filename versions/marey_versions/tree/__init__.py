"""Ordered maps that are cut into chunks by their content, so that versions share the chunks that are equal.

A tree maps keys (text, sorted by code point) to values (JSON objects). Its leaves contain the entries, and the chunks
above contain the last key, the digest and the number of entries of each chunk below. The shape of a tree depends on its
entries alone, never on the order of the changes that led to them, so equal maps have the same root digest everywhere.
"""

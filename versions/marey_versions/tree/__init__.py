"""Ordered maps that are cut into chunks at places that depend on their content, so that versions share equal chunks.

A tree maps keys (text that is not empty, sorted by code point) to values (JSON objects). Its leaves contain the
entries. Each chunk above the leaves contains, for every chunk directly below it, the last key, the digest and the
number of entries. The shape of a tree depends only on its entries, never on the order of earlier changes. So equal maps
have the same root digest on every server.
"""

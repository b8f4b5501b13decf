"""Rows and bytes: all SQL lives here.

A service function takes a `Transaction` first, authorises the transaction's principal, and does one thing.
"""

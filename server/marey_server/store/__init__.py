"""Store of rows and bytes; all SQL of the server is in this package.

A service function takes a `Transaction` first, authorises the transaction's principal, and does one thing.
"""

"""Database and blob storage; all SQL of the server is in this package.

A public function takes a `Transaction` as its first argument, checks that the transaction's principal may do what it
does, and does one thing.
"""

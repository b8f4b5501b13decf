"""Database and blob storage; all SQL of the server is in this package.

A public function takes a `Transaction` as its first argument, checks what the transaction's principal may do, and does
one thing.
"""

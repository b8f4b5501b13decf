"""Archives: one tar file with a version of a dataset, all versions before it, and everything that they contain.

The name of each member contains the digest of its content; the name of a list of changes contains the digest of the
commit. The digest of the newest commit covers all members, so that an archive can be checked without a server.
"""

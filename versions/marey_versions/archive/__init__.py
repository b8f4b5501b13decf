"""Archives: one tar file with a version of a dataset, all versions before it, and everything that they contain.

Each member of the file is named by the digest of its content. The digest of the commit covers all of them, so that an
archive can be checked without a server.
"""

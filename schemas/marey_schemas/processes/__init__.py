"""Child processes: their environment without secrets, their messages, their limits, and their termination.

Messages are bytes, and `pickle` is never used.
"""

"""Fault injection into a running server: killed workers, lost answers and repeated requests, in a scratch project."""

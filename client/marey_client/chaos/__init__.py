"""Test of a running server by faults: killed workers, lost answers and repeated requests, in a scratch project."""

"""Load tests of a running server: tiny jobs at given rates, through the same requests as those of all clients."""

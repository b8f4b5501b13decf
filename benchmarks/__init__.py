"""Speed beside peers: each benchmark runs Marey and its peer in turn, in one process, and prints ratios."""

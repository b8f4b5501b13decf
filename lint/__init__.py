"""Rules of this code base that no common linter checks. `python -m lint` prints offences, and fails if there are any.

Each module of `RULES` in `lint.__main__` is one rule with a function `find`. Exceptions, each with its reason, are in
`exceptions.toml`; texts that are still to be rewritten are counted per file in `wording.toml`, and may only get fewer.
"""

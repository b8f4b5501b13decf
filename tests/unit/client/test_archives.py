"""Files of archives and of copies between datasets, without a server."""

from __future__ import annotations

from marey_client.archives.writing import short_name

MOST_CHARACTERS = 255
"""Greatest length of a file name in usual file systems."""


def digest(number: int) -> str:
    return f"sha256:{number:064x}"


def test_the_name_of_an_archive_is_short_although_it_leaves_out_many_versions() -> None:
    bases = [digest(number) for number in range(1000)]
    name = short_name(digest(2000), bases)
    assert len(f"{name}.tar.{name}.part") < MOST_CHARACTERS
    assert short_name(digest(2000), reversed(bases)) == name


def test_archives_with_other_versions_have_other_names() -> None:
    one, other, third = map(digest, (1, 2, 3))
    names = {short_name(one, [other]), short_name(other, [one]), short_name(one, []), short_name(one, [other, third])}
    assert len(names) == 4

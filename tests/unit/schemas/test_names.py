"""Names and digests in documents."""

import pytest
from pydantic import TypeAdapter, ValidationError

from marey_schemas.item_files import original_of_clip
from marey_schemas.names import Digest, is_digest

SOME = f"sha256:{'0f' * 32}"


@pytest.mark.parametrize("text", [SOME[:-1], f"{SOME}0", SOME.upper(), f"{SOME}\n", f" {SOME}", SOME[7:], ""])
def test_a_digest_has_64_hexadecimal_digits_after_the_name_of_the_hash(text: str) -> None:
    assert is_digest(SOME)
    assert not is_digest(text)
    assert TypeAdapter(Digest).validate_python(SOME) == SOME
    with pytest.raises(ValidationError):
        TypeAdapter(Digest).validate_python(text)


@pytest.mark.parametrize("stored", ["walk.bvh", "take/walk.bvh", "C:\\takes\\walk.bvh"])
def test_an_original_has_its_name_without_folders_also_if_an_earlier_version_stored_them(stored: str) -> None:
    original = original_of_clip("clip_1", {"source": {"file": "sha256:0", "file_name": stored}})
    assert original is not None
    assert original.name == "walk.bvh"

"""The numbers of examples that generated tests draw in each tier."""

from types import SimpleNamespace

import pytest
from tests.support import tiers
from tests.support.tiers import EXAMPLES, TIERS, examples


@pytest.mark.parametrize(("tier", "drawn"), [("check", (10, 10)), ("test", (25, 25)), ("soak", (200, 600))])
def test_only_the_tier_soak_multiplies_the_number_that_is_given_for_it(
    tier: str, drawn: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    profile = SimpleNamespace(max_examples=round(TIERS[tier].effort * EXAMPLES))
    monkeypatch.setattr(tiers, "hypothesis", SimpleNamespace(settings=SimpleNamespace(default=profile)))
    assert (examples(50), examples(50, soak=150)) == drawn

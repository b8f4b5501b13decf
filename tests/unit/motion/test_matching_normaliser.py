from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from marey_motion.errors import MotionError
from marey_motion.gait import generate_gait, studio_skeleton
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database, union_normaliser, with_normaliser
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.matching.features import feature_layout
from marey_motion.matching.normaliser import Normaliser, fit_normaliser
from marey_motion.rigs import map_joints
from marey_schemas.options.matching import DatabaseOptions, FeatureWeights

DEFAULTS = DatabaseOptions()
BODY = MatchingBody.from_mapping(studio_skeleton(), map_joints(studio_skeleton()))
LAYOUT = feature_layout(DatabaseOptions(), BODY)


def database_of(*speeds: float, options: DatabaseOptions = DEFAULTS) -> MatchingDatabase:
    clips = [SourceClip(f"{speed}", f"{speed}", generate_gait(speed, 0.2, 2.0)) for speed in speeds]
    return build_database(clips, BODY, options)


def test_offsets_are_means_and_each_group_has_the_mean_deviation_over_its_weight() -> None:
    features = np.random.default_rng(0).normal(size=(500, 27)) * np.arange(1, 28) + np.arange(27)
    normaliser = fit_normaliser(features, LAYOUT, "sha256:x")
    for d in range(27):
        assert normaliser.offset[d] == pytest.approx(sum(features[:, d]) / 500, rel=1e-12)
    groups = [(0, 3, 0.75), (3, 6, 0.75), (6, 9, 1.0), (9, 12, 1.0), (12, 15, 1.0), (15, 21, 1.0), (21, 27, 1.5)]
    for start, stop, weight in groups:
        spreads = [np.sqrt(np.mean((features[:, d] - features[:, d].mean()) ** 2)) for d in range(start, stop)]
        np.testing.assert_allclose(normaliser.scale[start:stop], sum(spreads) / len(spreads) / weight, rtol=1e-12)
    np.testing.assert_allclose(normaliser.apply(features[:2]), (features[:2] - normaliser.offset) / normaliser.scale)
    assert normaliser.floored == ()


def test_what_hardly_varies_gets_the_least_scale_and_is_named() -> None:
    features = np.random.default_rng(1).normal(size=(100, 27))
    features[:, 12:15] = 0.5
    normaliser = fit_normaliser(features, LAYOUT, "sha256:x")
    assert np.all(normaliser.scale[12:15] == 1e-3)
    assert normaliser.floored == ("hip_velocity",)


def test_a_database_tells_of_groups_that_hardly_vary() -> None:
    still = generate_gait(0.0, 0.0, 1.0)
    clip = replace(still, poses=np.repeat(still.poses[:1], 60, axis=0))
    notes = build_database([SourceClip("a", "a", clip)], BODY).notes
    assert len([note for note in notes if note.code == "scale-floored"]) == 7


def test_a_group_without_weight_adds_nothing_to_any_cost() -> None:
    weights = FeatureWeights(trajectory_directions=0.0)
    database = database_of(1.0, 1.5, options=DatabaseOptions(weights=weights))
    normalised = database.normaliser.apply(database.features)
    assert np.ptp(normalised[:, 21:]) < 1e-25
    assert np.ptp(normalised[:, 15:21]) > 1.0


def test_a_normaliser_survives_being_kept_as_a_tree() -> None:
    fitted = database_of(1.0).normaliser
    again = Normaliser.from_tree(fitted.as_tree())
    assert again.digest == fitted.digest
    assert again.digest.startswith("sha256:")
    assert np.array_equal(again.offset, fitted.offset)
    assert np.array_equal(again.scale, fitted.scale)
    assert (again.names, again.floored, again.fitted_on) == (fitted.names, fitted.floored, fitted.fitted_on)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"offset": np.zeros(27)}, "the numbers of the normaliser were changed"),
        ({"scale": np.zeros(27)}, "scales finite and positive"),
        ({"scale": np.ones(3)}, "do not match"),
        ({"offset": np.full(27, np.nan)}, "must be finite"),
        ({"names": None}, "not a valid normaliser"),
        ({"offset": "abc"}, "not a valid normaliser"),
    ],
)
def test_a_tree_that_is_no_normaliser_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(MotionError, match=message) as caught:
        Normaliser.from_tree({**database_of(1.0).normaliser.as_tree(), **change})
    assert caught.value.code == "normaliser-invalid"


def test_a_pinned_normaliser_is_used_as_it_is() -> None:
    pinned = database_of(1.0, 2.0).normaliser
    clips = [SourceClip("a", "a", generate_gait(1.4, 0.0, 2.0))]
    assert build_database(clips, BODY, normaliser=pinned).normaliser is pinned
    assert build_database(clips, BODY).normaliser.digest != pinned.digest


@pytest.mark.parametrize(
    "options",
    [DatabaseOptions(extra_joints=("head",)), DatabaseOptions(horizons_s=(0.2, 0.4, 0.6))],
    ids=["more dimensions", "other dimensions"],
)
def test_a_pinned_normaliser_of_other_dimensions_is_refused(options: DatabaseOptions) -> None:
    pinned = database_of(1.0).normaliser
    with pytest.raises(MotionError, match="same joints and horizons") as caught:
        build_database([SourceClip("a", "a", generate_gait(1.4, 0.0, 2.0))], BODY, options, normaliser=pinned)
    assert caught.value.code == "normaliser-mismatch"
    with pytest.raises(MotionError, match="same joints and horizons"):
        with_normaliser(database_of(1.0, options=options), pinned)


def test_the_union_is_fitted_to_the_rows_of_all_databases_in_any_order() -> None:
    one, other = database_of(1.0, 1.5), database_of(2.0)
    union = union_normaliser([one, other])
    both = np.concatenate([one.features, other.features])
    np.testing.assert_allclose(union.offset, both.mean(axis=0), rtol=1e-12, atol=1e-15)
    assert union_normaliser([other, one]).digest == union.digest
    assert with_normaliser(one, union).normaliser is union


def test_databases_of_other_dimensions_or_weights_have_no_union() -> None:
    for options in (
        DatabaseOptions(extra_joints=("head",)),
        DatabaseOptions(weights=FeatureWeights(hip_velocity=2.0)),
    ):
        with pytest.raises(MotionError, match="build them with the same options") as caught:
            union_normaliser([database_of(1.0), database_of(1.0, options=options)])
        assert caught.value.code == "normaliser-mismatch"


def test_every_clip_twice_gives_the_same_normaliser() -> None:
    clips = [SourceClip(f"{speed}", "walk", generate_gait(speed, 0.2, 2.0)) for speed in (1.0, 2.0)]
    twice = [*clips, *(replace(clip, uid=f"{clip.uid} again") for clip in clips)]
    single, double = (build_database(many, BODY).normaliser for many in (clips, twice))
    np.testing.assert_allclose(double.offset, single.offset, atol=1e-14)
    np.testing.assert_allclose(double.scale, single.scale, rtol=1e-14)

"""Parsed models that are cached between requests, and samples drawn from them."""

import dataclasses
import io
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from tests.support.modelling_examples import bending_chains

from marey_motion.documents import skeleton_to_document
from marey_motion.modelling.primitive_documents import primitive_to_tree
from marey_motion.modelling.training import train_primitive
from marey_schemas.lru import LruCache
from marey_schemas.options.modelling import ModelOptions
from marey_server.errors import InvalidProblem
from marey_server.motions.models import (
    FoundModel,
    LoadedModel,
    UsableModel,
    parse_model,
    sample_document,
    sample_file,
    size_bytes,
)
from marey_server.store.items.reading import FoundPart

FOUND = FoundModel("model_1", "sway", FoundPart("sha256:" + "0" * 64, 3, 7, 1_000))


@pytest.fixture(scope="module")
def loaded() -> LoadedModel:
    options = ModelOptions(leave_one_out=False, folds=0, report_samples=0)
    primitive = train_primitive(bending_chains(), options, name="sway").primitive
    hierarchy = skeleton_to_document(primitive.skeleton).model_dump(mode="json", by_alias=True)
    return LoadedModel(primitive_to_tree(primitive, {"item": "skel_1", "revision": 1}), hierarchy)


def test_the_models_used_last_are_kept_within_bounds(loaded: LoadedModel) -> None:
    model = parse_model(loaded)
    assert size_bytes(model) > model.primitive.spatial.mean.nbytes
    roomy: LruCache[str, UsableModel] = LruCache(max_bytes=3 * size_bytes(model), size_of=size_bytes)
    tight: LruCache[str, UsableModel] = LruCache(max_bytes=size_bytes(model), size_of=size_bytes)
    for cache in (roomy, tight):
        for name in "abc":
            cache.put(name, parse_model(loaded))
    assert all(roomy.get(name) is not None for name in "abc")
    assert [tight.get(name) is not None for name in "abc"] == [False, False, True]
    assert roomy.get("a") is roomy.get("a")


def test_a_document_of_samples_names_its_model_and_seed(loaded: LoadedModel) -> None:
    document = sample_document(FOUND, parse_model(loaded), 3, 5)
    assert document["model"] == {"item": "model_1", "revision": 3, "digest": FOUND.part.digest}
    assert document["seed"] == 5
    assert len(document["motions"]) == len(document["latents"]) == 3
    assert document["motions"][0]["skeleton"] == {"item": "skel_1", "revision": 1}
    alone = sample_document(FOUND, parse_model(loaded), 1, 5)
    assert np.array_equal(alone["motions"][0]["poses"], document["motions"][0]["poses"])


def test_files_of_samples_are_the_same_bytes_alone_and_in_an_archive(loaded: LoadedModel) -> None:
    model = parse_model(loaded)
    one, many = (sample_file(FOUND, model, count, 2, "npz", "cm") for count in (1, 3))
    assert (one.name, many.name) == ("sway_2.npz", "sway_2.zip")
    assert zipfile.ZipFile(io.BytesIO(many.data)).read("sway_2_0001.npz") == one.data
    assert sample_file(FOUND, model, 3, 2, "npz", "cm").data == many.data


def test_samples_that_would_be_too_large_are_refused_before_they_are_made(loaded: LoadedModel) -> None:
    model = parse_model(loaded)
    slow = dataclasses.replace(
        model.primitive,
        temporal=dataclasses.replace(model.primitive.temporal, mean=model.primitive.temporal.mean + 14.0),
        duration_range_s=None,
        log_slope_range=None,
    )
    with pytest.raises(InvalidProblem, match="MiB; request fewer samples"):
        sample_document(FOUND, dataclasses.replace(model, primitive=slow), 2, 0)


def test_a_model_that_describes_nothing_is_refused(loaded: LoadedModel) -> None:
    broken = {**loaded.model, "mixture": {**loaded.model["mixture"]}}
    broken["mixture"]["covariances"] = np.zeros_like(loaded.model["mixture"]["covariances"])
    with pytest.raises(InvalidProblem, match="positive definite"):
        parse_model(LoadedModel(broken, loaded.hierarchy))


def test_a_server_starts_without_what_models_need() -> None:
    told = (
        "import sys, marey_server.app; print([name for name in ('sklearn', 'scipy', 'numba') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"

"""Workflow of two people who train the same model in different ways, and merge the versions of its dataset."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.support.command_line import CommandLine

from marey_client.handles.models import ModelHandle
from marey_client.project import ProjectHandle

pytestmark = pytest.mark.timeout(300)

QUICK: dict[str, Any] = {"report_samples": 20, "spatial_components": 1}


def train(lab: ProjectHandle, seed: int) -> ModelHandle:
    """Train the model `shared/walk`, or a new revision of it."""
    return lab.model(lab.train_model("aligned", name="walk", into="shared", seed=seed, **QUICK))


def documents(lab: ProjectHandle, model: ModelHandle) -> dict[str, str]:
    """Return the digest of each part of the newest revision of a model."""
    return {name: part.document for name, part in lab.models.get(model.id).item.parts.items()}


def test_of_two_models_one_is_chosen_with_everything_made_from_it(lab: ProjectHandle, run: CommandLine) -> None:
    model = train(lab, seed=1)
    gaits = lab.datasets.create("shared", collection="shared")
    gaits.commit("one model")
    gaits.create_branch("trial")
    train(lab, seed=2)
    gaits.commit("trained again")
    run("dataset", "checkout", "lab/shared@trial")
    train(lab, seed=3)
    theirs = documents(lab, model)
    drawn = model.sample(2, seed=4).latents
    gaits.commit("trained in another way", branch="trial")
    run("dataset", "checkout", "lab/shared")
    assert documents(lab, model)["model"] != theirs["model"]
    assert documents(lab, model)["report"] != theirs["report"]

    refused = run("dataset", "merge", "lab/shared@trial", status=1)
    assert "walk:model" in refused.stdout + refused.stderr
    run("dataset", "merge", "lab/shared@trial", "--theirs", "walk:model")
    run("dataset", "checkout", "lab/shared")
    assert documents(lab, model) == theirs
    assert np.array_equal(model.sample(2, seed=4).latents, drawn)

"""Thousands of clips that are written to a project in a few seconds: directly to the store, without HTTP."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.local_server import PROJECT, clip_parts
from benchmarks.material import noisy_clip
from marey_motion.documents import skeleton_to_document
from marey_schemas.access import ProjectCreate
from marey_schemas.documents.references import RevisionRef
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_server.access.principal import SYSTEM
from marey_server.app import open_database
from marey_server.process.settings import Settings
from marey_server.store import items, projects, users
from marey_server.store.database.connections import Database
from marey_server.store.transaction import Transaction

FRAMES, JOINTS = 4, 26
CLIPS_PER_WRITE = 500


def fill(data: Path, clips: int) -> None:
    """Create a data folder with a project that contains a skeleton and `clips` different short clips."""
    database = open_database(Settings(data=data))
    try:
        fill_database(database, clips)
    finally:
        database.close()


def fill_database(database: Database, clips: int) -> None:
    """Create a project that contains a skeleton and `clips` different short clips."""
    skeleton = database.write(SYSTEM, _make_project)
    for start in range(0, clips, CLIPS_PER_WRITE):
        database.write(SYSTEM, _make_clips, skeleton, range(start, min(clips, start + CLIPS_PER_WRITE)))


def _make_project(tx: Transaction) -> RevisionRef:
    tx.principal = users.administrator_principal(tx)
    projects.create_project(tx, ProjectCreate(name=PROJECT))
    hierarchy = skeleton_to_document(noisy_clip(FRAMES, JOINTS).skeleton).model_dump(by_alias=True)
    made = items.create_item(tx, PROJECT, Kind.SKELETON, ItemCreate(name="rig", parts={"hierarchy": hierarchy}))
    return RevisionRef(item=made.id, revision=1)


def _make_clips(tx: Transaction, skeleton: RevisionRef, numbers: range) -> None:
    tx.principal = users.administrator_principal(tx)
    parts = clip_parts(noisy_clip(FRAMES, JOINTS), skeleton)
    poses = parts["motion"]["poses"]
    assert isinstance(poses, np.ndarray)
    aside = np.zeros(poses.shape[1], np.float32)
    aside[0] = 1  # x of the root
    for number in numbers:
        shifted = parts["motion"] | {"poses": poses + aside * np.float32(number)}
        name, place = f"take {number:05d}", f"day {number // 1000}"
        wanted = ItemCreate(name=name, collection=place, tags=("walk",), parts=parts | {"motion": shifted})
        items.create_item(tx, PROJECT, Kind.CLIP, wanted)

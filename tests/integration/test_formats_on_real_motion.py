"""Every file of a collection of real motion capture is read correctly, or refused for the right reason."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.support.another_loader import files_to_compare, positions_by_another_loader

from marey_motion.errors import AmbiguousUnits, FormatError, MotionError
from marey_motion.formats import ImportedMotion, read_motion, write_bvh
from marey_motion.importing.body_measures import hip_heights
from marey_motion.importing.checks import CODES
from marey_motion.importing.landmarks import find_landmarks
from marey_motion.kinematics import global_positions, global_rotations
from marey_motion.quaternions import angle_between
from marey_schemas.formats.companions import pair_companions

Outcome = ImportedMotion | MotionError

# Files of too few joints to show a body, of markers, or without the skeleton they need.
REFUSED: dict[str, tuple[type[MotionError], str]] = {
    "c3d/135_02.c3d": (FormatError, "reader-absent"),
    "c3d/squat.c3d": (FormatError, "reader-absent"),
    "torture/zeros.amc": (FormatError, "asf-missing"),
    "torture/sinusoidal.bvh": (AmbiguousUnits, "units-ambiguous"),
    "torture/pybvh-rotation_first_root.bvh": (AmbiguousUnits, "units-ambiguous"),
    "torture/pybvh-full_precision_frame_time.bvh": (AmbiguousUnits, "units-ambiguous"),
}
# Position channels that are displacements, which loaders without that distinction fold to a point.
DISPLACED = ("rigs/makehuman/benchmark.bvh", "rigs/makehuman/tpose.bvh")
Z_UP = (
    "rigs/makehuman/",
    "torture/pybvh-bvh_test1.bvh",
    "torture/pybvh-bvh_test3.bvh",
    "torture/pybvh-standard_skeleton.bvh",
)


@dataclass(frozen=True)
class Collection:
    """The result of reading each file of a collection, and the collection's manifest."""

    folder: Path
    outcomes: dict[str, Outcome]
    manifest: dict[str, dict[str, str]]

    def motions(self) -> dict[str, ImportedMotion]:
        return {
            name: outcome
            for name, outcome in self.outcomes.items()
            if isinstance(outcome, ImportedMotion) and outcome.clip is not None
        }


@pytest.fixture(scope="module")
def collection(mocap: Path) -> Collection:
    with (mocap / "MANIFEST.csv").open(newline="") as table:
        manifest = {row["path"]: row for row in csv.DictReader(table)}
    companions = {pairing.file: pairing.companion for pairing in pair_companions(manifest)}
    outcomes: dict[str, Outcome] = {}
    for name in manifest:
        companion = companions.get(name)
        try:
            data = (mocap / name).read_bytes()
            second = (mocap / companion).read_bytes() if companion else None
            outcomes[name] = read_motion(data, name, companion=second, companion_name=str(companion))
        except MotionError as error:
            outcomes[name] = error
    return Collection(mocap, outcomes, manifest)


def test_only_what_cannot_be_understood_is_refused(collection: Collection) -> None:
    refused = {
        name: (type(outcome), outcome.code)
        for name, outcome in collection.outcomes.items()
        if isinstance(outcome, MotionError)
    }
    assert refused == REFUSED


def test_frames_rates_and_joints_are_those_of_the_manifest(collection: Collection) -> None:
    for name, motion in collection.motions().items():
        row = collection.manifest[name]
        assert motion.clip is not None
        assert motion.clip.frame_count == int(row["frames"]), name
        assert motion.clip.frame_rate_hz == pytest.approx(float(row["fps"]), rel=1e-4), name
        if name.endswith(".bvh"):
            assert motion.skeleton.joint_count == int(row["joints"]), name


def test_units_and_axes_are_right_for_every_rig(collection: Collection) -> None:
    for name, motion in collection.motions().items():
        scale = 0.1 if name in DISPLACED else float(collection.manifest[name]["unit_scale_to_m"])
        # The scale of one family follows from other takes of the same people alone; 1 cm is as good a body.
        assert motion.source.unit_scale_m == pytest.approx(scale, rel=0.15), name
        assert motion.source.up_axis == ("z" if name.startswith(Z_UP) else "y"), name


def test_hips_of_adults_are_at_the_height_of_hips(collection: Collection) -> None:
    for name, motion in collection.motions().items():
        if name.startswith("rigs/quadruped/") or name == "rigs/makehuman/benchmark.bvh":
            continue  # dogs, and one pose in the splits
        assert motion.clip is not None
        heights = hip_heights(global_positions(motion.clip).astype(np.float64), find_landmarks(motion.skeleton))
        assert 0.7 < np.median(heights) < 1.2, name


def test_known_flaws_are_found(collection: Collection) -> None:
    def codes(name: str) -> set[str]:
        outcome = collection.outcomes[name]
        assert isinstance(outcome, ImportedMotion)
        assert {warning.code for warning in outcome.warnings} <= set(CODES)
        return {warning.code for warning in outcome.warnings}

    assert "frame-count-mismatch" in codes("torture/Boxing_Toes.bvh")
    assert "mixed-rotation-orders" in codes("torture/pybvh-bvh_test1.bvh")
    assert "teleport" in codes("cmu-iclone-bvh/007_05.bvh")
    assert "rest-pose-frame" in codes("cmu-bvh/01_01.bvh")
    assert "position-channels-relative" in codes("rigs/makehuman/tpose.bvh")
    assert "in-place-gait" in codes("rigs/makehuman/walk1.bvh")
    assert "unit-inferred" in codes("rigs/quadruped/dog_run.bvh")


@pytest.mark.soak
def test_written_bvh_puts_every_joint_where_another_loader_saw_it_in_the_original(
    collection: Collection, tmp_path: Path
) -> None:
    motions = collection.motions()
    compared = files_to_compare([name for name in motions if name.endswith(".bvh")])
    assert len(compared) > 40
    for name in compared:
        motion = motions[name]
        assert motion.clip is not None
        path = tmp_path / "written.bvh"
        path.write_bytes(write_bvh(motion.clip, source=motion.source))
        written = positions_by_another_loader(path) * 0.01
        assert np.abs(written - global_positions(motion.clip)).max() < 1e-4, name
        if name in DISPLACED or name == "torture/Boxing_Toes.bvh":
            continue  # the other loader folds the first two and stops at the declared frames of the third
        original = positions_by_another_loader(collection.folder / name) * motion.source.unit_scale_m
        if motion.source.up_axis == "z":
            original = original[..., [0, 2, 1]] * [1, 1, -1]
        assert np.abs(written - original).max() < 1e-4, name


def test_a_take_in_both_formats_is_the_same_take(collection: Collection) -> None:
    """The BVH file of the take 11_01 has another skeleton, smoothed motion, and one more frame at the start.

    But the root turns exactly as in the AMC file. Scaled by the size of the body, the hips travel the same path.
    """
    motions = collection.motions()
    amc, bvh = motions["cmu-amc/11/11_01.amc"], motions["cmu-bvh/11_01.bvh"]
    assert amc.clip is not None
    assert bvh.clip is not None
    root_turns = angle_between(global_rotations(amc.clip)[:, 0], global_rotations(bvh.clip)[1:, 0])
    assert root_turns.max() < 1e-3

    def between_the_hips(motion: ImportedMotion, names: tuple[str, str]) -> NDArray[np.float64]:
        assert motion.clip is not None
        joints = [motion.skeleton.index_of(name) for name in names]
        path = global_positions(motion.clip)[:, joints].mean(axis=1).astype(np.float64)
        return path - path[-597:].mean(axis=0)

    ours = between_the_hips(amc, ("lfemur", "rfemur"))
    theirs = between_the_hips(bvh, ("lThigh", "rThigh"))[1:]
    turn, size = _rigid_and_scale(ours, theirs)
    assert size == pytest.approx(0.96, abs=0.01)
    assert np.linalg.norm(size * ours @ turn - theirs, axis=1).mean() < 0.01


def _rigid_and_scale(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the rotation r (3, 3) and the scale s that bring the points s · a @ r (n, 3) nearest to the points b.

    The method is that of Umeyama (1991), equations 40 to 42.
    """
    u, strength, v = np.linalg.svd(a.T @ b)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    return u @ np.diag(signs) @ v, float((strength * signs).sum() / (a**2).sum())

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.formats import ImportOptions, read_motion, write_bvh
from marey_motion.gait import GaitStyle, game_skeleton, generate_gait, studio_skeleton
from marey_motion.kinematics import forward_kinematics, global_positions
from marey_motion.looping import about_vertical, rotated
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database, database_digest
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.mirroring import mirror_clip
from marey_motion.retargeting import plan_retarget, retarget
from marey_motion.rigs import guess_axes, map_joints
from marey_motion.skeleton import Skeleton
from marey_schemas.options.matching import DatabaseOptions, EndPolicy

DEFAULTS = DatabaseOptions()
BODY = MatchingBody.from_mapping(studio_skeleton(), map_joints(studio_skeleton()))
WALK = generate_gait(1.3, 0.5, 3.0, style=GaitStyle.varied(2))


def built(
    clip: Clip, options: DatabaseOptions = DEFAULTS, body: MatchingBody = BODY, **source: Any
) -> MatchingDatabase:
    return build_database([SourceClip("one", "one", clip, **source)], body, options)


def stood(database: MatchingDatabase) -> NDArray[np.float32]:
    """Return the joint positions (N, J, 3) of all rows in the world, computed by the definition of the database."""
    poses = database.poses.astype(np.float64)
    poses[:, [0, 2]] = rotated(poses[:, [0, 2]], database.root_headings) + database.root_positions
    poses[:, 3:7] = quaternions.multiply(about_vertical(database.root_headings), poses[:, 3:7])
    return forward_kinematics(
        database.body.skeleton,
        poses,
        translations=None if database.translations is None else database.translations.astype(np.float64),
        translated_joints=database.translated_joints,
    )


def on_the_ground(clip: Clip, turn_rad: float, shift: tuple[float, float]) -> Clip:
    """Return the clip rotated about the vertical and shifted on the ground."""
    poses = clip.poses.astype(np.float64)
    poses[:, [0, 2]] = rotated(poses[:, [0, 2]], turn_rad) + shift
    poses[:, 3:7] = quaternions.multiply(about_vertical(np.array(turn_rad)), poses[:, 3:7])
    return replace(clip, poses=poses.astype(np.float32))


def game_walk() -> tuple[Clip, MatchingBody]:
    """Return a walk of a skeleton whose root is on the ground below the pelvis, and the body of this skeleton.

    The local axes of the root differ from those of the world.
    """
    target = game_skeleton()
    source = WALK.skeleton
    mapping, target_mapping = map_joints(source), map_joints(target)
    axes, target_axes = guess_axes(source, mapping), guess_axes(target, target_mapping)
    plan = plan_retarget(source, mapping, axes, target, target_mapping, target_axes)
    return retarget(WALK, plan), MatchingBody.from_mapping(target, target_mapping)


def left_behind(clip: Clip) -> tuple[Clip, MatchingBody]:
    """Return the clip below an added, rotated root that does not move, and the body of the new skeleton.

    The hips move by position channels.
    """
    plain = clip.skeleton
    start = np.array(quaternions.from_axis_angle((0.2, 1.0, 0.1), 0.7))
    skeleton = Skeleton(
        ("reference", *plain.joint_names),
        np.concatenate(([-1], plain.parents + 1)),
        np.concatenate(([[0.0, 0.0, 0.0]], plain.offsets)),
        np.concatenate((quaternions.identity(1), plain.rest_rotations)),
    )
    place = np.array([3.0, 0.5, -2.0])
    moved = quaternions.rotate_vectors(quaternions.conjugate(start), clip.root_translations - place)
    hips = quaternions.multiply(quaternions.conjugate(start), clip.rotations[:, 0].astype(np.float64))
    still = np.tile(np.concatenate((place, start)), (clip.frame_count, 1))
    poses = np.concatenate((still, hips, clip.poses[:, 7:]), axis=1).astype(np.float32)
    made = Clip(skeleton, clip.frame_rate_hz, poses, moved[:, None].astype(np.float32), (1,))
    return made, MatchingBody.from_mapping(skeleton, map_joints(skeleton))


class TestPoses:
    def test_rows_hung_from_their_roots_are_the_clip(self) -> None:
        np.testing.assert_allclose(stood(built(WALK)), global_positions(WALK), atol=2e-6)

    def test_a_root_below_the_hips_stands_under_the_body_and_all_else_is_the_clip(self) -> None:
        clip, body = game_walk()
        database = built(clip, body=body)
        below = [joint for joint in range(body.skeleton.joint_count) if body.hips in body.skeleton.path_to_root(joint)]
        assert body.carrier == body.hips == 1
        assert len(below) == body.skeleton.joint_count - 1
        np.testing.assert_allclose(stood(database)[:, below], global_positions(clip)[:, below], atol=2e-6)
        hips = stood(database)[:, [body.hips]] - stood(database)[:, [0]]
        np.testing.assert_allclose(np.linalg.norm(hips, axis=-1), 1.08, atol=1e-5)
        assert np.ptp(database.poses[:, 3:7], axis=0).max() < 1e-6

    def test_a_reference_that_is_left_behind_changes_no_row(self) -> None:
        clip, body = left_behind(WALK)
        np.testing.assert_allclose(global_positions(clip)[:, 1:], global_positions(WALK), atol=3e-6)
        database, plain = built(clip, body=body), built(WALK)
        assert database.translated_joints == ()
        np.testing.assert_allclose(database.features, plain.features, atol=2e-4)
        np.testing.assert_allclose(stood(database)[:, 1:], global_positions(WALK), atol=5e-6)
        assert np.abs(database.poses[:, :3]).max() < 0.2

    def test_joints_that_move_keep_their_translations_also_beside_clips_without(self) -> None:
        joints = (3, BODY.standard_joints["left_wrist"])
        moved = WALK.skeleton.offsets[list(joints)] + 0.05 * np.random.default_rng(0).normal(size=(180, 2, 3))
        moving = replace(WALK, translations=moved.astype(np.float32), translated_joints=joints)
        database = build_database([SourceClip("a", "a", WALK), SourceClip("b", "b", moving)], BODY)
        assert database.translated_joints == joints
        expected = np.concatenate((global_positions(WALK), global_positions(moving)))
        np.testing.assert_allclose(stood(database), expected, atol=2e-6)

    def test_a_body_without_toes_stands_on_its_ankles(self) -> None:
        joints = {name: joint for name, joint in map_joints(studio_skeleton()).joints.items() if "toe" not in name}
        body = MatchingBody.from_mapping(studio_skeleton(), replace(map_joints(studio_skeleton()), joints=joints))
        assert body.toes == body.feet
        assert built(WALK, body=body).contacts.any()


class TestWhatMustNotMatter:
    def test_half_a_turn_and_a_shift_on_the_ground_change_no_feature(self) -> None:
        """Positions are on a grid of 1/4096 m, so that the turn and the shift are exact in single precision."""
        poses = WALK.poses.copy()
        poses[:, :3] = np.round(poses[:, :3] * 4096) / 4096
        clip = replace(WALK, poses=poses)
        turned = poses.copy()
        turned[:, [0, 2]] = np.array([3.5, -8.25], np.float32) - poses[:, [0, 2]]
        w, x, y, z = poses[:, 3:7].T
        turned[:, 3:7] = np.stack((-y, z, w, -x), axis=1)
        here, there = built(clip), built(replace(WALK, poses=turned))
        np.testing.assert_allclose(there.features, here.features, atol=1e-9)
        np.testing.assert_allclose(there.pose_points, here.pose_points, atol=1e-6)

    @pytest.mark.parametrize("turn_rad", [0.3, 1.9, -2.6])
    def test_any_turn_and_shift_change_no_more_than_clips_can_hold(self, turn_rad: float) -> None:
        """Clips have single precision. At 8 m from the origin, errors are 5e-7 m, which is 2e-5 m/s over 1/30 s."""
        there = built(on_the_ground(WALK, turn_rad, (4.0, -7.0)))
        np.testing.assert_allclose(there.features, built(WALK).features, atol=5e-5)

    def test_the_order_of_the_clips_changes_no_byte(self) -> None:
        clips = [
            SourceClip(uid, uid, generate_gait(speed, 0.1, 2.0)) for uid, speed in (("c", 1.0), ("a", 2.0), ("b", 1.5))
        ]
        one, other = build_database(clips, BODY), build_database(clips[::-1], BODY)
        assert [clip.uid for clip in one.clips] == ["a", "b", "c"]
        assert database_digest(one) == database_digest(other)
        assert one.normaliser.digest == other.normaliser.digest
        assert one.poses.tobytes() == other.poses.tobytes()

    def test_other_clips_change_no_row(self) -> None:
        """Even neighbouring parts of one take change no row, because no row looks across the boundary of a clip."""
        parts = [SourceClip("a", "a", WALK.sliced(0, 90)), SourceClip("b", "b", WALK.sliced(90, 180))]
        both = build_database(parts, BODY)
        for part, entry in zip(parts, both.clips, strict=True):
            alone = build_database([part], BODY)
            rows = slice(entry.start, entry.stop)
            assert alone.features.tobytes() == both.features[rows].tobytes()
            assert alone.selectable.tobytes() == both.selectable[rows].tobytes()
        assert np.array_equal(both.clip_of_row, np.repeat([0, 1], 90))
        assert np.array_equal(both.starts, [0, 90, 180])

    @pytest.mark.parametrize("rate_hz", [24.0, 30.0, 50.0, 119.88, 120.0])
    def test_other_frame_rates_give_about_the_same_rows(self, rate_hz: float) -> None:
        other, plain = built(generate_gait(1.3, 0.4, 4.0, rate_hz)), built(generate_gait(1.3, 0.4, 4.0))
        rows = slice(40, min(other.row_count, plain.row_count) - 80)
        np.testing.assert_allclose(other.root_positions[rows], plain.root_positions[rows], atol=0.01)
        np.testing.assert_allclose(other.features[rows, 15:], plain.features[rows, 15:], atol=0.03)


class TestMirroring:
    def test_features_of_a_mirrored_clip_have_sides_swapped_and_left_negated(self) -> None:
        plain, mirrored = built(WALK), built(WALK, DatabaseOptions(mirroring="only"))
        columns = np.r_[3:6, 0:3, 9:12, 6:9, 12:27]
        signs = np.r_[np.tile([-1.0, 1.0, 1.0], 5), np.tile([-1.0, 1.0], 6)]
        np.testing.assert_allclose(mirrored.features, plain.features[:, columns] * signs, atol=1e-9)
        np.testing.assert_allclose(mirrored.root_positions, plain.root_positions * [-1, 1], atol=1e-12)
        np.testing.assert_allclose(mirrored.root_headings, -plain.root_headings, atol=1e-12)
        assert np.array_equal(mirrored.contacts, plain.contacts[:, ::-1])
        assert mirrored.clips[0].uid == "one~mirrored"
        assert mirrored.clips[0].mirrored_from == "one"

    def test_mirrored_rows_are_those_of_the_mirrored_clip(self) -> None:
        mirrored = built(WALK, DatabaseOptions(mirroring="only"))
        other = built(mirror_clip(WALK, BODY.partners))
        np.testing.assert_allclose(mirrored.features, other.features, atol=1e-4)

    def test_added_mirrored_clips_stand_beside_their_originals(self) -> None:
        clips = [SourceClip(uid, f"walk {uid}", WALK, tags=("walk",)) for uid in ("b", "a")]
        database = build_database(clips, BODY, DatabaseOptions(mirroring="add"))
        assert [clip.uid for clip in database.clips] == ["a", "a~mirrored", "b", "b~mirrored"]
        assert [clip.mirrored_from for clip in database.clips] == [None, "a", None, "b"]
        assert database.clips[1].name == "walk a (mirrored)"
        assert database.clips[1].tags == ("walk",)
        assert database.clips[3].stop == database.row_count == 4 * 180

    def test_each_pose_of_a_mirrored_left_turn_is_one_of_a_right_turn(self) -> None:
        left, right = generate_gait(1.2, 0.8, 5.0), generate_gait(1.2, -0.8, 5.0)
        mirrored = built(left, DatabaseOptions(mirroring="only"))
        apart = np.linalg.norm(mirrored.pose_points[60:200, None] - built(right).pose_points[None, 60:240], axis=-1)
        assert apart.max(axis=-1).min(axis=1).max() < 0.03
        unmirrored = np.linalg.norm(
            built(left).pose_points[60:200, None] - built(right).pose_points[None, 60:240], axis=-1
        )
        assert unmirrored.max(axis=-1).min(axis=1).max() > 0.05


class TestFrames:
    @pytest.mark.parametrize(("policy", "left_out"), [("clamp", 20), ("trim", 60), ("loop", 20)])
    def test_the_end_of_a_clip_cannot_be_chosen(self, policy: EndPolicy, left_out: int) -> None:
        selectable = built(WALK, DatabaseOptions(end_policy=policy)).selectable
        assert np.array_equal(selectable, np.arange(180) < 180 - left_out)

    @pytest.mark.parametrize("frames", [1, 2, 3, 4, 5, 20])
    def test_clips_too_short_to_look_ahead_are_kept_and_named(self, frames: int) -> None:
        database = built(WALK.sliced(0, frames))
        assert database.row_count == frames
        assert not database.selectable.any()
        assert [note.code for note in database.notes if note.clip] == ["too-short"]
        assert np.all(np.isfinite(database.features))

    @pytest.mark.parametrize("mirroring", ["none", "add", "only"])
    def test_a_clip_too_short_to_look_ahead_is_named_once(self, mirroring: str) -> None:
        database = built(WALK.sliced(0, 5), DatabaseOptions.model_validate({"mirroring": mirroring}))
        assert [note.code for note in database.notes if note.clip] == ["too-short"]

    def test_a_range_of_frames_is_that_part_of_the_clip(self) -> None:
        part, whole = built(WALK, frames=(30, 100)), built(WALK.sliced(30, 100))
        assert part.features.tobytes() == whole.features.tobytes()
        assert [one.clips[0].first_s for one in (part, whole)] == [30 / WALK.frame_rate_hz, 0.0]

    def test_rest_poses_at_the_ends_are_left_out_unless_wanted(self) -> None:
        rest = np.concatenate((WALK.skeleton.offsets[0], WALK.skeleton.rest_rotations.reshape(-1)))
        poses = np.concatenate((np.tile(rest, (12, 1)), WALK.poses, np.tile(rest, (5, 1)))).astype(np.float32)
        clip = replace(WALK, poses=poses)
        trimmed = built(clip)
        assert trimmed.features.tobytes() == built(WALK).features.tobytes()
        assert trimmed.clips[0].first_s == 12 / WALK.frame_rate_hz
        assert built(clip, frames=(4, 180)).clips[0].first_s == 12 / WALK.frame_rate_hz
        (note,) = trimmed.notes
        assert str(note) == "one: a rest pose was left out: 12 frames at the start and 5 at the end of the clip"
        assert built(clip, DatabaseOptions(keep_rest_poses=True)).row_count == 197

    def test_walking_on_the_spot_as_on_a_treadmill_is_flagged(self) -> None:
        straight = generate_gait(1.3, 0.0, 3.0)
        poses = straight.poses.copy()
        poses[:, 2] -= (1.3 * np.arange(180) / 60.0).astype(np.float32)
        database = built(replace(straight, poses=poses))
        assert database.clips[0].in_place
        assert [note.code for note in database.notes] == ["in-place-gait"]
        assert not built(straight).clips[0].in_place

    def test_a_file_in_centimetres_is_the_same_clip_as_one_in_metres(self) -> None:
        """The tolerance follows from the decimals in the files: six in centimetres, four in metres."""
        features = []
        for unit, scale_m in (("cm", 0.01), ("m", 1.0)):
            data = write_bvh(WALK, unit=unit)
            clip = read_motion(data, "walk.bvh", options=ImportOptions(unit_scale_m=scale_m)).clip
            assert clip is not None
            body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
            features.append(built(clip, body=body).features)
        np.testing.assert_allclose(features[1], features[0], atol=2e-4)
        np.testing.assert_allclose(features[0], built(WALK).features, atol=2e-4)


class TestRootBone:
    def test_a_root_that_leads_the_character_is_taken_as_it_is(self) -> None:
        clip, body = game_walk()
        poses = clip.poses.astype(np.float64)
        heading = 0.5 * np.arange(180) / 60.0
        rest = body.skeleton.rest_rotations[0]
        poses[:, 3:7] = quaternions.multiply(about_vertical(heading), rest)
        led = replace(clip, poses=poses.astype(np.float32))
        database = built(led, DatabaseOptions(root_mode="bone"), body)
        np.testing.assert_allclose(database.root_positions, led.root_translations[:, [0, 2]], atol=1e-12)
        np.testing.assert_allclose(database.root_headings, heading, atol=1e-6)
        np.testing.assert_allclose(stood(database)[:, 1:], global_positions(led)[:, 1:], atol=3e-6)

    def test_a_root_heads_where_the_rest_pose_faces_turned_as_the_root_is_turned(self) -> None:
        clip, body = game_walk()
        rests = body.skeleton.rest_rotations.copy()
        rests[0] = quaternions.multiply(about_vertical(np.array(0.8)), rests[0])
        aside = replace(body, skeleton=replace(body.skeleton, rest_rotations=rests))
        poses = clip.poses.astype(np.float64)
        turned = 0.5 * np.arange(180) / 60.0
        poses[:, 3:7] = quaternions.multiply(about_vertical(turned), rests[0])
        led = replace(clip, skeleton=aside.skeleton, poses=poses.astype(np.float32))
        database = built(led, DatabaseOptions(root_mode="bone"), aside)
        np.testing.assert_allclose(database.root_headings, 0.8 + turned, atol=1e-6)


class TestRefusals:
    def test_clips_of_another_skeleton_are_refused_by_name(self) -> None:
        clip, _ = game_walk()
        with pytest.raises(MotionError, match="stray: the clip has a different skeleton") as caught:
            build_database([SourceClip("a", "walk", WALK), SourceClip("b", "stray", clip)], BODY)
        assert caught.value.code == "skeleton-mismatch"

    def test_bones_of_other_lengths_are_another_skeleton(self) -> None:
        with pytest.raises(MotionError, match="a different skeleton"):
            built(generate_gait(1.2, 0.0, 1.0, stature_m=1.6))

    def test_a_uid_names_one_clip(self) -> None:
        with pytest.raises(MotionError, match="second and first have the same uid") as caught:
            build_database([SourceClip("a", "second", WALK), SourceClip("a", "first", WALK)], BODY)
        assert caught.value.code == "uid-repeated"

    def test_frames_that_are_not_there_are_refused_by_name(self) -> None:
        with pytest.raises(MotionError, match="one, slice: the range of frames 100:500"):
            built(WALK, frames=(100, 500))

    def test_no_clips_make_no_database(self) -> None:
        with pytest.raises(MotionError, match="none were given"):
            build_database([], BODY)

    def test_a_body_that_never_faces_anywhere_is_refused_by_name(self) -> None:
        offsets = WALK.skeleton.offsets.copy()
        for joint in (*BODY.lefts, *BODY.rights, *(WALK.skeleton.parents[j] for j in (*BODY.lefts, *BODY.rights))):
            offsets[joint, [0, 2]] = 0.0
        skeleton = replace(WALK.skeleton, offsets=offsets, end_sites=())
        poses = np.tile(np.concatenate(([0, 1, 0], skeleton.rest_rotations.reshape(-1))), (30, 1)).astype(np.float32)
        body = replace(BODY, skeleton=skeleton)
        with pytest.raises(MotionError, match="one: the forward direction of the body cannot be computed") as caught:
            built(Clip(skeleton, 60.0, poses), DatabaseOptions(keep_rest_poses=True), body)
        assert caught.value.code == "heading-undefined"


def test_progress_tells_of_every_clip() -> None:
    told: list[tuple[Any, ...]] = []
    clips = [SourceClip("b", "second", WALK), SourceClip("a", "first", WALK)]
    build_database(clips, BODY, DatabaseOptions(mirroring="add"), progress=lambda *news: told.append(news))
    assert told == [(1, 2, "first"), (2, 2, "second")]

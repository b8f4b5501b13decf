"""Quaternions, compared with an independent library, analytic cases and algebraic laws."""

from collections.abc import Callable
from itertools import permutations, product
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp
from tests.support.tiers import examples

from marey_motion import quaternions as q
from marey_motion.arrays import AnyFloats, Floats
from marey_motion.errors import RotationError
from marey_motion.quaternions.conversions import LOCKED

ORDERS = tuple("".join(axes) for axes in product("xyz", repeat=3) if axes[0] != axes[1] != axes[2])
components = st.floats(-10.0, 10.0, allow_subnormal=False)
vectors = hnp.arrays(np.float64, 3, elements=components).filter(lambda v: np.linalg.norm(v) > 1e-3)
rotations = (
    hnp.arrays(np.float64, 4, elements=components)
    .filter(lambda v: np.linalg.norm(v) > 1e-3)
    .map(lambda v: q.normalise(v))
)


def scipy_of(rotation: AnyFloats) -> Any:
    return Rotation.from_quat(rotation, scalar_first=True)


def same_rotation(a: AnyFloats, b: AnyFloats, tolerance: float = 1e-12) -> bool:
    return bool(np.all(q.angle_between(a, b) <= tolerance))


@pytest.fixture
def many() -> AnyFloats:
    return q.normalise(np.random.default_rng(7).normal(size=(500, 4)))


def test_there_are_twelve_orders_of_three_axes() -> None:
    assert len(ORDERS) == 12


@given(rotations, rotations)
def test_multiplying_does_the_right_factor_first(a: Floats, b: Floats) -> None:
    assert same_rotation(q.multiply(a, b), (scipy_of(a) * scipy_of(b)).as_quat(scalar_first=True), 1e-7)


@given(rotations, vectors)
def test_vectors_turn_as_the_matrix_and_scipy_turn_them(rotation: Floats, v: Floats) -> None:
    np.testing.assert_allclose(q.rotate_vectors(rotation, v), scipy_of(rotation).apply(v), atol=1e-12)
    np.testing.assert_allclose(q.rotate_vectors(rotation, v), q.as_matrix(rotation) @ v, atol=1e-12)


@given(rotations)
def test_a_rotation_times_its_conjugate_is_none(rotation: Floats) -> None:
    np.testing.assert_allclose(q.multiply(rotation, q.conjugate(rotation)), q.identity(), atol=1e-14)


def test_leading_axes_broadcast(many: AnyFloats) -> None:
    left, right = many[:6].reshape(2, 3, 1, 4), many[6:10]
    result = q.multiply(left, right)

    assert result.shape == (2, 3, 4, 4)
    np.testing.assert_allclose(result[1, 2, 3], q.multiply(left[1, 2, 0], right[3]))


def test_float32_stays_float32_and_integers_become_float64() -> None:
    single = np.array([1, 0, 0, 0], dtype=np.float32)

    assert q.multiply(single, single).dtype == np.float32
    assert q.from_euler("xyz", np.zeros(3, dtype=np.float32)).dtype == np.float32
    assert q.multiply([1, 0, 0, 0], [0, 1, 0, 0]).dtype == np.float64
    assert q.rotate_vectors(single, [1.0, 0.0, 0.0]).dtype == np.float64


@pytest.mark.parametrize("intrinsic", [True, False])
@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_agree_with_scipy_in_all_orders_both_ways(order: str, intrinsic: bool, many: AnyFloats) -> None:
    sequence = order.upper() if intrinsic else order
    angles = np.random.default_rng(1).uniform(-4, 4, size=(500, 3))

    made = Rotation.from_euler(sequence, angles).as_quat(scalar_first=True)
    assert same_rotation(q.from_euler(order, angles, intrinsic=intrinsic), made, 1e-12)
    difference = q.as_euler(many, order, intrinsic=intrinsic) - scipy_of(many).as_euler(sequence)
    np.testing.assert_allclose(np.angle(np.exp(1j * difference)), 0.0, atol=1e-7)


@pytest.mark.parametrize("order", ORDERS)
def test_in_gimbal_lock_the_angles_still_make_the_rotation_and_the_first_turn_is_none(order: str) -> None:
    locks = (0.0, np.pi) if order[0] == order[2] else (np.pi / 2, -np.pi / 2)
    angles = np.random.default_rng(2).uniform(-3, 3, size=(40, 3))
    angles[:, 1] = np.repeat(locks, 20)
    locked = q.from_euler(order, angles)
    back = q.as_euler(locked, order)

    assert same_rotation(q.from_euler(order, back), locked, 1e-7)
    np.testing.assert_array_equal(back[:, 2], 0.0)


@given(rotations, st.sampled_from(ORDERS), st.booleans())
def test_a_rotation_survives_euler_angles_of_any_order(rotation: Floats, order: str, intrinsic: bool) -> None:
    angles = q.as_euler(rotation, order, intrinsic=intrinsic)

    # Two components that together are shorter than LOCKED may point anywhere. So the quaternion changes by less than
    # 2 LOCKED, and the angle of a rotation is twice that of its quaternion.
    assert same_rotation(q.from_euler(order, angles, intrinsic=intrinsic), rotation, 4 * LOCKED)
    assert np.all(np.abs(angles) <= np.pi + 1e-12)


def test_one_or_two_axes_are_an_order_too() -> None:
    np.testing.assert_allclose(q.from_euler("y", [[0.3]]), q.from_axis_angle([[0, 1, 0]], [0.3]))
    np.testing.assert_allclose(q.from_euler("zx", [0.3, 0.4]), q.from_euler("zxy", [0.3, 0.4, 0.0]))


def test_a_long_take_converts_like_its_parts() -> None:
    angles = np.random.default_rng(3).uniform(-3, 3, size=(q.EULER_BLOCK + 10, 2, 3))
    whole = q.from_euler("zxy", angles)

    assert whole.shape == (q.EULER_BLOCK + 10, 2, 4)
    np.testing.assert_array_equal(whole[-5:], q.from_euler("zxy", angles[-5:]))


@pytest.mark.parametrize("order", ["", "xx", "xyzx", "xxy", "abc", "xy z"])
def test_an_order_that_is_none_is_refused(order: str) -> None:
    with pytest.raises(RotationError, match="order of axes"):
        q.from_euler(order, np.zeros((1, max(1, len(order)))))


def test_three_axes_are_needed_to_read_angles_back() -> None:
    with pytest.raises(RotationError, match="three"):
        q.as_euler(q.identity(), "zx")


@given(rotations)
def test_a_rotation_survives_its_matrix(rotation: Floats) -> None:
    assert same_rotation(q.from_matrix(q.as_matrix(rotation)), rotation, 1e-14 * 100)


@pytest.mark.parametrize("axis", np.concatenate((np.eye(3), [[1, 1, 0], [1, -1, 1]])))
def test_half_turns_survive_their_matrix(axis: Floats) -> None:
    half_turn = q.from_axis_angle(axis, np.pi)
    assert same_rotation(q.from_matrix(q.as_matrix(half_turn)), half_turn, 1e-12)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (2 * np.eye(3), "scales"),
        (np.diag([1, 1, -1]), "mirrors"),
        (np.full((3, 3), np.nan), "scales"),
        (np.eye(2), "expected"),
        (np.zeros(3), "expected"),
    ],
)
def test_matrices_that_are_no_rotations_are_refused(matrix: NDArray[Any], words: str) -> None:
    with pytest.raises(RotationError, match=words):
        q.from_matrix(matrix)


def test_signed_permutations_of_the_axes_are_exact() -> None:
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.eye(3)[list(order)] * signs
            if np.linalg.det(matrix) > 0:
                np.testing.assert_allclose(q.as_matrix(q.from_matrix(matrix)), matrix, atol=1e-15)


@given(rotations)
def test_rotation_vectors_agree_with_scipy_and_lead_back(rotation: Floats) -> None:
    vector = q.as_rotation_vector(rotation)

    assert np.linalg.norm(vector) <= np.pi + 1e-12
    assert same_rotation(q.from_rotation_vector(vector), rotation, 1e-12)
    assert same_rotation(Rotation.from_rotvec(vector).as_quat(scalar_first=True), rotation, 1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-20, 1e-8, 1e-4])
def test_tiny_rotations_keep_their_relative_precision(angle: float) -> None:
    vector = q.as_rotation_vector(q.from_rotation_vector([0.0, angle, 0.0]))
    np.testing.assert_allclose(vector, [0.0, angle, 0.0], rtol=1e-12)


def test_the_angle_between_rotations_is_that_of_the_shorter_way() -> None:
    for angle in (0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi):
        turned = q.from_axis_angle([0, 1, 0], angle)
        assert q.angle_between(q.identity(), turned) == pytest.approx(angle, rel=1e-6, abs=1e-15)
        assert q.angle_between(q.identity(), -turned) == pytest.approx(angle, rel=1e-6, abs=1e-15)


@settings(max_examples=examples(50))
@given(rotations, rotations, st.floats(0.0, 1.0))
def test_slerp_agrees_with_scipy(a: Floats, b: Floats, t: float) -> None:
    assume(q.angle_between(a, b) < np.pi - 1e-3)
    expected = Slerp([0.0, 1.0], Rotation.concatenate([scipy_of(a), scipy_of(b)]))(t).as_quat(scalar_first=True)
    assert same_rotation(q.slerp(a, b, t), expected, 1e-7)


def test_slerp_meets_its_ends_and_moves_at_constant_speed(many: AnyFloats) -> None:
    a, b = many[:250], many[250:]
    np.testing.assert_allclose(q.slerp(a, b, 0.0), a, atol=1e-15)
    assert same_rotation(q.slerp(a, b, 1.0), b, 1e-12)
    quarter = q.angle_between(a, q.slerp(a, b, 0.25))
    np.testing.assert_allclose(quarter, 0.25 * q.angle_between(a, b), atol=1e-7)


def test_slerp_between_equal_or_opposite_signs_of_a_rotation_stays_there() -> None:
    rotation = q.from_axis_angle([1, 2, 3], 0.7)
    np.testing.assert_allclose(q.slerp(rotation, rotation, 0.3), rotation, atol=1e-15)
    np.testing.assert_allclose(q.slerp(rotation, -rotation, 0.3), rotation, atol=1e-15)


@given(vectors, vectors)
def test_the_rotation_between_vectors_brings_one_onto_the_other(start: Floats, end: Floats) -> None:
    turned = q.rotate_vectors(q.between_vectors(start, end), start / np.linalg.norm(start))
    np.testing.assert_allclose(turned, end / np.linalg.norm(end), atol=1e-13)


@given(vectors, st.sampled_from([0.0, 1e-13, 1e-10, 1e-7, 1e-5, 1e-3]))
def test_nearly_opposite_vectors_are_met_exactly_too(start: Floats, off: float) -> None:
    start = start / np.linalg.norm(start)
    end = -start + off * np.roll(start, 1)
    turned = q.rotate_vectors(q.between_vectors(start, end), start)
    np.testing.assert_allclose(turned, end / np.linalg.norm(end), atol=1e-13)


def test_opposite_vectors_turn_about_the_axis_asked_for() -> None:
    np.testing.assert_allclose(
        q.rotate_vectors(q.between_vectors([0, -1, 0], [0, 1, 0], half_turn_axis=[0.2, 5.0, 0.0]), [1, 0, 0]), [1, 0, 0]
    )
    np.testing.assert_allclose(
        q.rotate_vectors(q.between_vectors([0, -1, 0], [0, 1, 0], half_turn_axis=[0, 0, 1]), [1, 0, 0]),
        [-1, 0, 0],
        atol=1e-15,
    )


def test_the_shortest_rotation_has_its_axis_across_both_vectors() -> None:
    turn = q.as_rotation_vector(q.between_vectors([1, 0, 0], [0, 2, 0]))
    np.testing.assert_allclose(turn, [0, 0, np.pi / 2], atol=1e-15)


@pytest.mark.parametrize(
    "make", [q.normalise, lambda v: q.from_axis_angle(v[:3], 1.0), lambda v: q.between_vectors(v[:3], [1, 0, 0])]
)
def test_what_has_no_direction_is_refused(make: Callable[..., Any]) -> None:
    with pytest.raises(RotationError, match="length zero"):
        make(np.zeros(4))


@given(rotations, vectors)
def test_twist_then_swing_is_the_rotation(rotation: Floats, axis: Floats) -> None:
    twist, swing = q.twist_swing(rotation, axis)
    along = axis / np.linalg.norm(axis)

    assert same_rotation(q.multiply(swing, twist), rotation, 1e-7)
    np.testing.assert_allclose(np.cross(twist[1:], along), 0.0, atol=1e-12)
    assert abs(swing[1:] @ along) < 1e-7


def test_a_swing_of_half_a_turn_has_no_twist() -> None:
    twist, swing = q.twist_swing(q.from_axis_angle([1, 0, 0], np.pi), [0, 1, 0])
    np.testing.assert_allclose(twist, q.identity(), atol=1e-15)
    assert same_rotation(swing, q.from_axis_angle([1, 0, 0], np.pi))


@given(st.lists(st.booleans(), min_size=2, max_size=40))
def test_unrolling_undoes_any_flips_of_sign(flips: list[bool]) -> None:
    smooth = q.from_axis_angle(np.tile([0, 1, 0], (len(flips), 1)), np.linspace(0, 2.0, len(flips)))
    flipped = np.where(np.array(flips)[:, None], -smooth, smooth)

    np.testing.assert_array_equal(q.unroll(flipped), smooth if not flips[0] else -smooth)


def test_unrolling_works_along_any_axis(many: AnyFloats) -> None:
    by_frame = many.reshape(100, 5, 4)
    np.testing.assert_array_equal(q.unroll(by_frame.swapaxes(0, 1), axis=1).swapaxes(0, 1), q.unroll(by_frame))


def test_a_constant_spin_has_its_angular_velocity_in_every_frame() -> None:
    spin = np.array([0.3, 1.1, -0.4])
    times = np.arange(20)[:, None] / 60.0
    rotation = q.multiply(q.from_rotation_vector(spin * times), q.from_axis_angle([1, 0, 0], 0.4))

    np.testing.assert_allclose(q.angular_velocity(rotation, 60.0), np.tile(spin, (20, 1)), atol=1e-9)


def test_a_steadily_quickening_spin_is_met_at_the_ends_too() -> None:
    times = np.arange(9) / 60.0
    rotation = q.from_axis_angle(np.tile([0, 1, 0], (9, 1)), 0.5 * 3.0 * times**2)

    np.testing.assert_allclose(q.angular_velocity(rotation, 60.0)[:, 1], 3.0 * times, atol=1e-9)


@pytest.mark.parametrize(("frames", "speed"), [(1, 0.0), (2, 0.6)])
def test_one_frame_stands_still_and_two_move_evenly(frames: int, speed: float) -> None:
    rotation = q.from_axis_angle(np.tile([0, 1, 0], (frames, 1)), np.arange(frames) * 0.01)
    np.testing.assert_allclose(q.angular_velocity(rotation, 60.0)[:, 1], speed, atol=1e-12)


def test_shapes_that_are_no_quaternions_are_refused() -> None:
    with pytest.raises(RotationError, match=r"\(3,\)"):
        q.multiply(np.zeros(3), np.zeros(4))

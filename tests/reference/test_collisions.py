"""Impacts of the reference keep what they must and separate as they should."""

import numpy as np
import pytest

from tests.reference import collisions


def momentum(mass, inertia, pose, twist) -> np.ndarray:
    linear = mass[:, None] * twist[:, :2]
    orbital = pose[:, 0] * linear[:, 1] - pose[:, 1] * linear[:, 0]
    return np.array([*linear.sum(axis=0), np.sum(inertia * twist[:, 2] + orbital)])


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_an_impact_off_centre_keeps_momentum_and_obeys_restitution(restitution):
    rng = np.random.default_rng(1)
    for _ in range(20):
        mass, inertia = rng.uniform(0.5, 2.0, 2), rng.uniform(0.05, 0.5, 2)
        pose, point = rng.normal(size=(2, 3)), rng.normal(size=2)
        arm = point - pose[:, :2]
        angle = rng.uniform(0, 2 * np.pi)
        normal = np.array([np.cos(angle), np.sin(angle)])
        twist = rng.normal(size=(2, 3))
        turned = np.column_stack([-arm[:, 1], arm[:, 0]])

        def opening(twist, turned=turned, normal=normal):
            along = (twist[:, :2] + twist[:, 2:] * turned) @ normal
            return along[1] - along[0]

        after = collisions.impact(mass, inertia, twist, arm, normal, restitution)
        np.testing.assert_allclose(
            momentum(mass, inertia, pose, after),
            momentum(mass, inertia, pose, twist),
            atol=1e-12,
        )
        before = opening(twist)
        expected = -restitution * before if before < 0 else before
        np.testing.assert_allclose(opening(after), expected, atol=1e-12)


def test_an_elastic_impact_keeps_energy():
    mass, inertia = np.array([1.0, 3.0]), np.array([0.2, 0.4])
    twist = np.array([[2.0, 0.3, 1.0], [-1.0, 0.1, -2.0]])
    arm = np.array([[0.4, 0.1], [-0.3, 0.2]])
    after = collisions.impact(mass, inertia, twist, arm, [1.0, 0.0], 1.0)
    rates = np.column_stack([mass, mass, inertia])
    np.testing.assert_allclose(np.sum(rates * after**2), np.sum(rates * twist**2))
    assert not np.allclose(after, twist)


def test_equal_balls_head_on_swap_their_velocities():
    state = np.array([[0.0, 0, 0, 2.0, 0, 0], [1.0, 0, 0, -1.0, 0, 0]])
    after = collisions.two_balls([0.2, 0.2], 5.0, state, 1.0, 1.0)
    np.testing.assert_allclose(after[:, 3], [-1.0, 2.0], atol=1e-12)
    # They meet 0.2 s after the start with centres at 0.4 m and 0.8 m.
    np.testing.assert_allclose(after[:, 0], [0.4 - 0.8, 0.8 + 1.6], atol=1e-12)


def test_balls_that_pass_do_not_meet():
    state = np.array([[0.0, 0, 0, 2.0, 0, 0], [1.0, 0.5, 0, -1.0, 0, 0]])
    after = collisions.two_balls([0.2, 0.2], 5.0, state, 1.0, 1.0)
    np.testing.assert_allclose(after[:, :2], [[2.0, 0.0], [0.0, 0.5]])
    receding = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 0.0], [1.0, 0.0]])
    assert collisions.meeting_time(*receding, 0.4) == np.inf


def test_the_last_ball_of_a_row_leaves_with_the_speed_of_the_first():
    position = np.array([0.0, 1.0, 1.25, 1.5])
    moved, velocity = collisions.row_of_balls(position, [2.0, 0, 0, 0], 0.2, 1.0)
    np.testing.assert_allclose(velocity, [0.0, 0.0, 0.0, 2.0])
    # Each ball stops where its successor was, less a diameter; gaps take time.
    np.testing.assert_allclose(moved[:3], [0.8, 1.05, 1.3])
    np.testing.assert_allclose(moved[3], 1.5 + 2.0 * (1.0 - (0.8 + 0.05 + 0.05) / 2.0))

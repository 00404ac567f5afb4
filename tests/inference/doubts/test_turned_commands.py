"""Wrenches whose axes are not those of the poses: turned, mirrored, the body's own."""

import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.doubts.corrections import unmoved_reason
from boomdp_jax.inference.doubts.residual_report import describe_law
from tests.inference import residual_worlds as worlds
from tests.inference.recordings import DT, NOISE
from tests.inference.residual_checks import IMPULSE, assert_names, check

QUIET = np.array([1e-4, 1e-4])


def turned_by(angle, vector: np.ndarray) -> np.ndarray:
    """Forces turned by an angle, or by one each; torques as they are."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, torque = vector.T
    return np.column_stack([cos * x - sin * y, sin * x + cos * y, torque])


def recorded(seed: int, told) -> History:
    """A box, and of its wrenches what was written down.

    Args:
        seed: of the recording.
        told: from states and wrenches as they acted, `[time, ...]`.
    """
    table = worlds.box_table(np.random.default_rng(seed), 100)
    state, acted, next_state = table
    rows = (part[:, None] for part in (state, told(state, acted), next_state))
    return make_history(*rows, DT)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [10.0, -20.0])
def test_a_force_sensor_that_is_turned_against_the_camera_is_named(degrees):
    """Torques are right, and so is the mass: what is turned is the angle's sine."""
    angle = np.radians(degrees)
    history = recorded(21, lambda state, acted: turned_by(-angle, acted))
    (found,) = check([history])
    assert_names(found, "turned", [np.sin(angle)])
    text = describe_law(found.laws[0])
    said = float(text.split("an angle of ")[1].split()[0])
    assert abs(said - degrees) < 4.0 * np.degrees(found.laws[0].fit.sd[0])
    assert "degrees, counterclockwise (log Bayes factor " in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "mirror"),
    [
        ("x_negated", [[-1.0, 0.0], [0.0, 1.0]]),
        ("y_negated", [[1.0, 0.0], [0.0, -1.0]]),
        ("exchanged", [[0.0, 1.0], [1.0, 0.0]]),
    ],
)
def test_axes_that_are_negated_or_exchanged_are_named(name, mirror):
    def told(state, acted):
        return np.column_stack([acted[:, :2] @ np.array(mirror).T, acted[:, 2]])

    (found,) = check([recorded(22, told)], impulse=20.0 * IMPULSE)
    best = found.laws[0]
    assert best.law.name == name
    assert best.fit.log_bayes_factor > 10.0
    np.testing.assert_allclose(best.fit.coefficient, [1.0], atol=0.25)


@pytest.mark.slow
def test_wrenches_in_the_bodys_own_frame_are_named():
    history = recorded(23, lambda state, acted: turned_by(-state[:, 2], acted))
    (found,) = check([history], impulse=20.0 * IMPULSE)
    best = found.laws[0]
    assert best.law.name == "own_frame"
    assert best.fit.log_bayes_factor > 10.0
    np.testing.assert_allclose(best.fit.coefficient, [1.0], atol=0.25)


@pytest.mark.slow
def test_noise_that_a_wrong_law_was_taken_for_does_not_hide_it():
    """By five degrees, with all of it inferred to be noise of the motion.

    Measured by that noise there is nothing decisive to be said for the law.
    """
    angle = np.radians(5.0)

    def told(state, acted):
        return turned_by(-angle, acted)

    found, right = check([recorded(24, told), recorded(24, lambda state, acted: acted)])
    assert_names(found, "turned", [np.sin(angle)])
    (law,) = [each for each in right.laws if each.law.name == "turned"]
    assert law.fit.log_bayes_factor < np.log(2000.0)


@pytest.mark.slow
def test_a_box_with_right_axes_shows_none_of_it():
    """Twenty of them, whose noise is taken to be as it is and far more than it is."""
    rng = np.random.default_rng(25)
    histories = [worlds.record_box(rng, 60) for _ in range(20)]
    for impulse in (QUIET, IMPULSE):
        for found in check(histories, impulse=impulse):
            assert found.laws[0].fit.log_bayes_factor < np.log(2000.0)


@pytest.mark.slow
def test_what_nothing_told_moves_is_told_from_what_is_disturbed():
    """A box that wrenches of others move, and one that is kicked beside its own."""
    rng = np.random.default_rng(26)

    def held(values: np.ndarray) -> np.ndarray:
        return np.repeat(values[::10], 10, axis=0)

    acted = held(rng.normal(size=(100, 3)) * [20.0, 20.0, 3.0])
    others = held(rng.normal(size=(100, 3)) * [2.0, 2.0, 0.3])
    kicks = acted / 10.0 + rng.normal(size=(100, 3)) * [20.0, 20.0, 3.0]
    found = check(
        [moved_by(acted, others), moved_by(kicks, acted / 10.0)],
        impulse=np.array([0.2, 1.0]),
    )
    reasons = [
        unmoved_reason("box", each.persistence[0], each.by_chance[0]) for each in found
    ]
    assert min(each.by_chance[0] for each in found) > 1.0
    assert reasons[0] is not None
    assert reasons[1] is None


def moved_by(acted: np.ndarray, told: np.ndarray) -> History:
    """A box that starts at rest, under wrenches `[time, 3]`, in closed form."""
    change = DT * worlds.INVERSE * acted
    twist = np.vstack([np.zeros(3), np.cumsum(change, axis=0)])
    middle = 0.5 * (twist[1:] + twist[:-1])
    pose = np.vstack([np.zeros(3), np.cumsum(DT * middle, axis=0)])
    path = np.hstack([pose, twist])
    path = path + NOISE * np.random.default_rng(27).normal(size=path.shape)
    rows = (part[:, None] for part in (path[:-1], told, path[1:]))
    return make_history(*rows, DT)

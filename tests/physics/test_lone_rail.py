"""Drawers and welds of a lone body on the fast path, against the general one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import Params, State, empty_params, rollout, step
from tests.physics.retraced import OnGeneralPath
from tests.physics.scenes import make_scene
from tests.reference.planar_dynamics import World

SCENE = make_scene(World([(0.3, 0.1)], [20.0]))
NUM_CASES = 128
PLACE = jnp.array([0.4, -0.2])
AXIS, ANGLE = 0.7, 0.3


def turn(angle, vector):
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[cos, -sin], [sin, cos]]) @ vector


def changed(module, **fields):
    return type(module)(**{**vars(module), **fields})


def hypothesis(key, kind: str | None) -> Params:
    """A body with slots for pin, drawer, weld and floor, of which some are active."""
    keys = iter(jax.random.split(key, 12))

    def around(middle, *shape):
        return middle * jnp.exp(jax.random.normal(next(keys), shape))

    anchor = jax.random.uniform(next(keys), (1, 2), minval=-0.3, maxval=0.3)
    world = PLACE[None] + turn(ANGLE, anchor[0])[None]
    on = {name: jnp.array([name == kind]) for name in ("revolute", "prismatic", "weld")}
    params = empty_params(1, num_revolute=1, num_prismatic=1, num_weld=1, num_ground=1)
    ends = {"anchor_a": anchor, "anchor_b": world}
    return changed(
        params,
        density=around(20.0, 1),
        revolute=changed(
            params.revolute,
            active=on["revolute"],
            viscous=around(0.1, 1),
            dry=around(0.5, 1),
            **ends,
        ),
        prismatic=changed(
            params.prismatic,
            active=on["prismatic"],
            axis=jnp.array([AXIS]),
            angle=jnp.array([ANGLE]),
            viscous=around(2.0, 1),
            dry=around(1.0, 1),
            **ends,
        ),
        weld=changed(params.weld, active=on["weld"], angle=jnp.array([ANGLE]), **ends),
        ground=changed(
            params.ground,
            active=jax.random.bernoulli(next(keys), shape=(1, 1)),
            dry=around(0.1, 1, 1),
            viscous=around(100.0, 1, 1),
            torque_share=jnp.full((1, 1), 0.3),
            load_shift=jnp.full((1, 1, 2), 0.02),
        ),
    )


def case(key, kind):
    """A hypothesis, a state that obeys it, and a wrench."""
    keys = jax.random.split(key, 4)
    slide, speed = jax.random.normal(keys[0], (2,))
    direction = jnp.array([jnp.cos(AXIS), jnp.sin(AXIS)])
    place = PLACE + (slide * direction if kind == "prismatic" else 0.0)
    twist = jnp.append(speed * direction, 0.0) * (kind == "prismatic")
    params = hypothesis(keys[1], kind)
    if kind is None:
        twist = jax.random.normal(keys[2], (3,))
    state = State(jnp.append(place, ANGLE)[None], twist[None])
    wrench = jax.random.normal(keys[3], (1, 3)) * jnp.array([[8.0, 8.0, 1.0]])
    return params, state, wrench


def cases(kind, seed=0):
    keys = jax.random.split(jax.random.key(seed), NUM_CASES)
    return jax.vmap(lambda key: case(key, kind))(keys)


def many_steps(params, state, wrench, dt):
    wrenches = jnp.broadcast_to(wrench, (5, *wrench.shape))
    return rollout(SCENE, params, state, wrenches, dt=dt)[0].array


@pytest.fixture(scope="module")
def paths():
    """Both paths, each compiled once."""
    many = jax.vmap(many_steps, in_axes=(0, 0, 0, None))
    return jax.jit(many), OnGeneralPath(many)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["prismatic", "weld", None])
def test_fast_path_agrees_with_the_general_one(paths, kind):
    fast, general = paths
    for dt, tolerance in ((0.001, 1e-6), (0.02, 1e-3)):
        arguments = (*cases(kind), jnp.asarray(dt))
        difference = np.abs(np.asarray(fast(*arguments)) - general(*arguments))
        worst = np.max(difference, axis=(1, 2, 3))
        # Where a rail and a floor rub, the paths blend start and end of a step with
        # weights of their own, which differ in the third order of its length.
        assert np.quantile(worst, 0.9) < tolerance
        if kind == "prismatic":
            has_floor = np.asarray(arguments[0].ground.active)[:, 0, 0]
            assert np.max(worst[~has_floor]) < 1e-9


@pytest.mark.slow
def test_a_weld_holds_its_pose_to_the_bit_whatever_was_read(paths):
    params, state, wrench = cases("weld")
    pose = state.pose + 0.003 * jax.random.normal(jax.random.key(1), state.pose.shape)
    end = np.asarray(paths[0](params, State(pose, state.twist + 0.1), wrench, 0.02))
    assert np.all(end[..., 3:] == 0.0)
    expected = np.append(np.asarray(PLACE), ANGLE)
    np.testing.assert_allclose(
        end[..., :3], np.broadcast_to(expected, end[..., :3].shape)
    )


@pytest.mark.slow
def test_a_drawer_reads_only_what_lies_along_its_line(paths):
    params, state, wrench = cases("prismatic")
    across = jnp.array([-jnp.sin(AXIS), jnp.cos(AXIS)])
    offset = jnp.append(0.01 * across, 0.02)[None, None]
    off = State(state.pose + offset, state.twist + offset)
    usual = np.asarray(paths[0](params, state, wrench, 0.02))
    np.testing.assert_allclose(
        np.asarray(paths[0](params, off, wrench, 0.02)), usual, atol=1e-12
    )


def test_a_pinned_drawer_does_not_move(paths):
    params, state, wrench = cases("prismatic")
    pin = changed(params.revolute, active=params.prismatic.active)
    end = np.asarray(paths[0](changed(params, revolute=pin), state, wrench, 0.02))
    expected = np.append(np.asarray(PLACE), ANGLE)
    np.testing.assert_allclose(
        end[..., :3], np.broadcast_to(expected, end[..., :3].shape), atol=1e-12
    )
    assert np.all(end[..., 3:] == 0.0)


@pytest.mark.slow
def test_dry_friction_of_a_drawer_stops_it_where_the_closed_form_says():
    params = hypothesis(jax.random.key(0), "prismatic")
    dry, mass = 2.0, float(params.density[0] * SCENE.area[0])
    guide = changed(params.prismatic, viscous=jnp.array([1e4]), dry=jnp.array([dry]))
    ground = changed(params.ground, active=jnp.zeros((1, 1), bool))
    params = changed(params, prismatic=guide, ground=ground)
    direction = np.array([np.cos(AXIS), np.sin(AXIS)])
    start = State(
        jnp.append(PLACE, ANGLE)[None], jnp.append(jnp.asarray(direction), 0.0)[None]
    )
    num = int(np.ceil(mass / dry / float(SCENE.dt))) + 5
    states, _ = rollout(SCENE, params, start, jnp.zeros((num, 1, 3)))
    stopped = np.asarray(states.pose[-1, 0, :2]) - np.asarray(PLACE)
    np.testing.assert_allclose(stopped, 0.5 * mass / dry * direction, atol=1e-3)
    np.testing.assert_allclose(states.twist[-1], 0.0, atol=1e-9)


@pytest.mark.slow
def test_gradients_are_finite_and_zero_where_a_slot_is_off():
    params, state, wrench = case(jax.random.key(3), "prismatic")

    def end(numbers, kind):
        guide = changed(params.prismatic, **numbers)
        active = jnp.array([kind == "prismatic"])
        guide = changed(guide, active=active)
        return jnp.sum(
            step(SCENE, changed(params, prismatic=guide), state, wrench)[0].array
        )

    numbers = {
        key: getattr(params.prismatic, key)
        for key in ("anchor_a", "anchor_b", "axis", "angle", "viscous", "dry")
    }
    for kind, is_zero in (("prismatic", False), ("none", True)):
        slopes = jax.grad(end)(numbers, kind)
        assert all(np.all(np.isfinite(slope)) for slope in slopes.values())
        total = sum(float(jnp.sum(jnp.abs(slope))) for slope in slopes.values())
        assert (total == 0.0) == is_zero


def with_wheels(params, key, half_track):
    """Two wheels, of which some are active, anywhere on the body."""
    keys = iter(jax.random.split(key, 6))
    more = empty_params(1, num_wheel=2).wheel
    shape = more.viscous.shape
    limit = jnp.exp(jax.random.normal(next(keys), shape))
    is_viscous = jax.random.bernoulli(next(keys), 0.2, shape)
    wheel = changed(
        more,
        active=jax.random.bernoulli(next(keys), 0.8, shape[:2]),
        position=0.2 * jax.random.normal(next(keys), shape),
        heading=3.0 * jax.random.normal(next(keys), shape[:2]),
        viscous=jnp.exp(jax.random.normal(next(keys), shape) + 1.0),
        dry=jnp.where(is_viscous, jnp.inf, limit),
        half_track=jnp.full(shape[:2], half_track) if half_track else None,
    )
    return changed(params, wheel=wheel)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        "prismatic",
        *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("weld", "revolute")),
        pytest.param(None, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("half_track", [None, 0.1], ids=["one contact", "a track"])
def test_wheels_of_a_body_with_a_slot_for_a_drawer(paths, kind, half_track):
    fast, general = paths
    params, state, wrench = cases(kind)
    keys = jax.random.split(jax.random.key(9), NUM_CASES)
    params = jax.vmap(lambda p, key: with_wheels(p, key, half_track))(params, keys)
    # Without a floor both paths weigh start and end of a step alike.
    no_floor = changed(params.ground, active=jnp.zeros_like(params.ground.active))
    params = changed(params, ground=no_floor)
    dt = jnp.asarray(0.001)
    found = np.asarray(fast(params, state, wrench, dt))
    gap = np.abs(found - np.asarray(general(params, state, wrench, dt)))
    worst = np.max(gap, axis=(1, 2, 3))
    assert np.quantile(worst, 0.9) < 1e-6
    assert np.max(worst) < 1e-3


@pytest.mark.slow
def test_a_wheel_across_its_line_holds_a_drawer_up_to_its_limit():
    """Terminal speed and rest, from the law along the line by itself."""
    turned, force = 0.5, 3.0
    params = hypothesis(jax.random.key(3), "prismatic")
    zero = jnp.zeros(1)
    guide = changed(params.prismatic, viscous=zero, dry=zero)
    off = changed(params.ground, active=jnp.zeros((1, 1), bool))
    viscous, dry = np.array([2.0, 30.0]), np.array([1.0, 4.0])
    wheel = changed(
        empty_params(1, num_wheel=1).wheel,
        active=jnp.ones((1, 1), bool),
        position=jnp.full((1, 1, 2), 0.2),
        heading=jnp.full((1, 1), AXIS - ANGLE + turned),
        viscous=jnp.asarray(viscous)[None, None],
        dry=jnp.asarray(dry)[None, None],
    )
    params = changed(params, prismatic=guide, ground=off, wheel=wheel)
    direction = np.array([np.cos(AXIS), np.sin(AXIS)])
    way = np.array([np.cos(turned), np.sin(turned)])
    resistance = float(viscous @ way**2)
    limit = resistance / float(np.linalg.norm(viscous * way / dry))
    state = State(jnp.append(PLACE, ANGLE)[None], jnp.zeros((1, 3)))
    for push in (0.5 * limit, limit + force):
        wrench = jnp.asarray(np.append(push * direction, 0.0))[None, None]
        wrenches = jnp.broadcast_to(wrench, (200, 1, 3))
        end = rollout(SCENE, params, state, wrenches, dt=0.02)[0].twist[-1, 0]
        mass = float(params.density[0] * SCENE.area[0])
        free = (push - limit) / mass * 4.0
        speed = push / resistance if push < limit else free
        along = float(jnp.dot(end[:2], direction))
        # It takes a moment until the limit is reached.
        most = limit / resistance
        assert along == pytest.approx(speed, rel=1e-6, abs=most * (push > limit))
        assert float(end[2]) == 0.0


@pytest.mark.slow
def test_a_pinned_body_turns_as_far_with_slots_for_everything_else(paths):
    """More than a radian a substep, where the general solver would lose energy."""
    params, state, _ = cases("revolute")
    keys = jax.random.split(jax.random.key(4), NUM_CASES)
    params = jax.vmap(lambda p, key: with_wheels(p, key, None))(params, keys)
    wheel = changed(params.wheel, active=jnp.zeros_like(params.wheel.active))
    zero = jnp.zeros_like(params.revolute.dry)
    pin = changed(params.revolute, viscous=zero, dry=zero)
    off = changed(params.ground, active=jnp.zeros_like(params.ground.active))
    params = changed(params, wheel=wheel, ground=off, revolute=pin)
    arm = jax.vmap(lambda a: turn(ANGLE, a[0]))(pin.anchor_a)
    spin = jnp.full(NUM_CASES, 12.0)
    twist = jnp.stack([spin * arm[:, 1], -spin * arm[:, 0], spin], axis=1)
    begun = State(state.pose, twist[:, None])
    dt = jnp.asarray(0.2)
    end = np.asarray(paths[0](params, begun, jnp.zeros((NUM_CASES, 1, 3)), dt))
    np.testing.assert_allclose(end[:, -1, 0, 5], 12.0, rtol=1e-9)
    np.testing.assert_allclose(end[:, -1, 0, 2], ANGLE + 12.0, rtol=1e-9)

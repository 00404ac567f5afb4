"""The solver for a lone body against the general one, which shares no equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import Params, State, step
from boomdp_jax.physics.params import Distance, Ground, Revolute, Wheel
from tests.physics.retraced import OnGeneralPath, Retraced
from tests.physics.scenes import make_scene
from tests.reference.planar_dynamics import World

SCENE = make_scene(World([(0.3, 0.1)], [20.0]))
ONE_FOOT = type(SCENE)(
    **{
        **vars(SCENE),
        "feet": SCENE.feet[:, :1],
        "foot_load": jnp.ones((1, 1)),
        "num_substeps": 1,
    }
)
"""The same on a single foot and in one substep, which compiles faster."""
SHORT = 0.002
"""A step [s] so short that the two paths' ways to keep a pose on its pin agree: one
turns the body about the pin, the other moves it and puts it back, which differs by the
third power of the step."""
NUM_CASES = 512


def draw(key, spread: float, has_nuisances: bool):
    """A hypothesis with random masks and numbers, a state that obeys it, a wrench.

    Coefficients and limits are lognormal with the given standard deviation; four means
    four decades each way: ground of 1e8 N s/m, limits of a milligram's weight.
    """
    keys = iter(jax.random.split(key, 24))

    def normal(*shape):
        return jax.random.normal(next(keys), shape)

    def uniform(low, high, *shape):
        return jax.random.uniform(next(keys), shape, minval=low, maxval=high)

    has_pin, has_wheel, has_ground = jax.random.bernoulli(next(keys), shape=(3,))
    theta, spin, slide, position = uniform(-3.0, 3.0), normal(), normal(2), normal(2)
    anchor = uniform(-0.3, 0.3, 2)
    no_number = jnp.zeros(0)
    params = Params(
        density=20.0 * jnp.exp(0.5 * normal(1)),
        revolute=Revolute(
            active=has_pin[None],
            body_a=jnp.zeros(1, jnp.int32),
            body_b=jnp.full(1, -1, jnp.int32),
            anchor_a=anchor[None],
            anchor_b=jnp.zeros((1, 2)),
            viscous=0.1 * jnp.exp(spread * normal(1)),
            dry=0.5 * jnp.exp(spread * normal(1)),
        ),
        distance=Distance(
            active=jnp.zeros(0, bool),
            body_a=jnp.zeros(0, jnp.int32),
            body_b=jnp.zeros(0, jnp.int32),
            anchor_a=jnp.zeros((0, 2)),
            anchor_b=jnp.zeros((0, 2)),
            length=no_number,
        ),
        wheel=Wheel(
            active=has_wheel[None, None],
            position=uniform(-0.3, 0.3, 1, 1, 2),
            heading=uniform(-3.0, 3.0, 1, 1),
            viscous=jnp.array([[[5.0, 60.0]]]) * jnp.exp(spread * normal(1, 1, 2)),
            dry=jnp.array([[[1.0, 8.0]]]) * jnp.exp(spread * normal(1, 1, 2)),
            half_track=uniform(0.0, 0.2, 1, 1) if has_nuisances else None,
        ),
        ground=Ground(
            active=has_ground[None, None],
            dry=0.3 * jnp.exp(0.7 * spread * normal(1, 1)),
            viscous=300.0 * jnp.exp(2.0 * spread * normal(1, 1)),
            torque_share=uniform(0.0, 1.0, 1, 1) if has_nuisances else None,
            load_shift=0.05 * normal(1, 1, 2) if has_nuisances else None,
        ),
    )
    state = State(jnp.append(position, theta)[None], jnp.append(slide, spin)[None])
    wrench = normal(1, 3) * jnp.array([[5.0, 5.0, 1.0]])
    return *on_the_pin(params, state), wrench


def on_the_pin(params: Params, state: State) -> tuple[Params, State]:
    """The same with the pin where its anchor is, and the body turning about it."""
    pin, (x, y, theta), spin = params.revolute, state.pose[0], state.twist[0, 2]
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    arm = jnp.array([[cos, -sin], [sin, cos]]) @ pin.anchor_a[0]
    turning = jnp.stack([spin * arm[1], -spin * arm[0], spin])[None]
    pin = Revolute(**{**vars(pin), "anchor_b": (jnp.stack([x, y]) + arm)[None]})
    twist = jnp.where(pin.active, turning, state.twist)
    params = Params(**{**vars(params), "revolute": pin})
    return params, State(state.pose, twist)


def draws(spread: float = 1.0, *, has_nuisances: bool = True, seed: int = 0):
    """Many of them."""
    keys = jax.random.split(jax.random.key(seed), NUM_CASES)
    return jax.jit(jax.vmap(lambda key: draw(key, spread, has_nuisances)))(keys)


def run_step(params, state, wrench, scene=SCENE, dt=None):
    """One step of one hypothesis."""
    return step(scene, params, state, wrench, dt=dt)[0].array


def run_short_step(params, state, wrench):
    """A shorter one."""
    return run_step(params, state, wrench, dt=SHORT)


# Compiled once for each set of slots, whatever they hold.
fast_step = jax.jit(jax.vmap(run_step))
fast_short_step = jax.jit(jax.vmap(run_short_step))


@jax.vmap
def step_of_length(params, state, wrench, dt):
    """The same with a length that is data."""
    return run_step(params, state, wrench, dt=dt)


general_step = OnGeneralPath(step_of_length)


def worst_of_each(array, expected):
    """Largest difference of each hypothesis."""
    array, expected = np.asarray(array), np.asarray(expected)
    difference = np.abs(array - expected).reshape(len(array), -1)
    assert np.all(np.isfinite(difference))
    return np.max(difference, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("has_nuisances", [True, False], ids=["full", "plain"])
def test_fast_path_agrees_with_the_general_one(has_nuisances):
    patient = OnGeneralPath(step_of_length, NUM_LATE=(60, 60, 300), _NUM_LINES=60)
    for spread in (1.0, 4.0):
        cases = draws(spread, has_nuisances=has_nuisances)
        is_free = ~np.asarray(cases[0].revolute.active[:, 0])
        for dt, function in ((SHORT, fast_short_step), (float(SCENE.dt), fast_step)):
            lengths = jnp.full(NUM_CASES, dt)
            usual = general_step(*cases, lengths)
            difference = worst_of_each(function(*cases), usual)
            if dt == SHORT:
                # The general path keeps redundant rows solvable by a softness of 4e-10,
                # and takes a pin's lever to stand as at mid-step.
                assert np.sum(difference > 1e-6) < 4
                assert np.quantile(difference, 0.99) < 2e-7
            else:
                # Of hypotheses with four decades each way one in some hundreds is not
                # solved by either.
                assert np.mean(difference > 5e-5) < 0.01
                # Of a turn of 0.01 rad or so that is a share of the square.
                assert np.quantile(difference, 0.9) < 1e-5
                assert np.quantile(difference[is_free], 0.9) < 1e-12
                solved = patient(*cases, lengths)
                assert np.mean(worst_of_each(usual, solved) > 5e-5) < 0.005


@pytest.mark.slow
def test_fast_path_agrees_with_itself_in_single_precision():
    double = np.asarray(fast_step(*draws()))
    single = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == jnp.float64 else leaf,
        (SCENE, draws()),
    )
    with jax.enable_x64(False):
        scene, cases = single
        result = jax.jit(jax.vmap(lambda p, s, w: step(scene, p, s, w)[0].array))(
            *cases
        )
    assert result.dtype == jnp.float32
    # Stiff contacts are held to a stiffness of 1e-4 / eps there, which shows as a creep
    # of one part in a thousand of what would have been the velocity.
    difference = worst_of_each(np.asarray(result), double)
    assert np.quantile(difference, 0.9) < 1e-4
    assert np.quantile(difference, 0.99) < 1e-2


@pytest.mark.slow
def test_friction_is_solved_to_the_end():
    cases = draws(seed=1)
    usual = np.asarray(fast_short_step(*cases))
    solved = OnGeneralPath(jax.vmap(run_short_step), NUM_NEWTON=40)(*cases)
    difference = worst_of_each(usual, solved)
    # One hypothesis in a thousand may need more iterations than there are: with 512
    # cases, four or more of those have a probability of two in a thousand.
    assert np.sum(difference > 1e-7) < 4, np.sort(difference)[-8:]


@pytest.mark.slow
def test_the_rest_of_a_batch_changes_no_bit():
    # Newton's method goes on for all while one needs it; nobody else may notice.
    cases = draws(spread=4.0, seed=4)
    usual = np.asarray(fast_step(*cases))
    is_other = np.arange(NUM_CASES) % 3 > 0
    at_rest = jax.tree.map(
        lambda leaf: jnp.where(
            is_other.reshape(-1, *(1 for _ in leaf.shape[1:])),
            jnp.zeros_like(leaf),
            leaf,
        ),
        cases[1:],
    )
    found = np.asarray(fast_step(cases[0], *at_rest))
    np.testing.assert_array_equal(found[~is_other], usual[~is_other])
    assert np.mean(np.any(found != usual, axis=(1, 2))[is_other]) > 0.9


@pytest.mark.slow
def test_a_fixed_number_of_iterations_finds_the_same():
    # What other backends than a CPU do, forwards and in derivatives.
    cases = draws(seed=5)
    keys = jax.random.split(jax.random.key(6), NUM_CASES)
    usual = np.asarray(fast_step(*cases))
    rate = np.asarray(jax.jit(jax.vmap(forward))(*cases, keys))
    without = ("physics.lone_step", "_search", lambda body, now, force: (None, body))
    fixed = np.asarray(Retraced(jax.vmap(run_step), without)(*cases))
    other = Retraced(jax.vmap(forward), without)(*cases, keys)
    assert np.any(fixed != usual), "both made the same iterations"
    assert np.quantile(worst_of_each(usual, fixed), 0.99) < 1e-9
    scale = np.max(np.abs(rate.reshape(NUM_CASES, -1)), axis=1)
    assert np.quantile(worst_of_each(rate, other) / scale, 0.99) < 1e-7


@pytest.mark.slow
def test_masks_that_are_off_leave_a_free_body():
    params, state, wrench = draws()
    off = jax.tree.map(
        lambda leaf: jnp.zeros_like(leaf) if leaf.dtype == bool else leaf, params
    )
    end = np.asarray(fast_step(off, state, wrench))[:, 0]
    mass = np.asarray(off.density[:, 0] * SCENE.area[0])
    inertia = mass * float(SCENE.gyration[0])
    push = np.asarray(wrench[:, 0]) / np.stack([mass, mass, inertia], axis=1)
    dt, twist = float(SCENE.dt), np.asarray(state.twist[:, 0])
    np.testing.assert_allclose(end[:, 3:], twist + dt * push, rtol=1e-12, atol=1e-12)
    moved = np.asarray(state.pose[:, 0]) + dt * twist + 0.5 * dt**2 * push
    np.testing.assert_allclose(end[:, :3], moved, rtol=1e-12, atol=1e-12)


def split(params):
    """Numbers of a hypothesis, and what puts them back."""
    leaves, treedef = jax.tree.flatten(params)
    is_number = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]
    numbers = [leaf for n, leaf in zip(is_number, leaves, strict=True) if n]

    def join(numbers):
        moving = iter(numbers)
        full = [
            next(moving) if n else leaf
            for n, leaf in zip(is_number, leaves, strict=True)
        ]
        return jax.tree.unflatten(treedef, full)

    return numbers, join


def inputs_and_direction(params, state, wrench, key):
    """A step as a function of all its numbers, those, and a random direction."""
    numbers, join = split(params)
    inputs = (numbers, state, wrench)
    leaves, treedef = jax.tree.flatten(inputs)
    keys = jax.random.split(key, len(leaves))
    # Relative changes of a hypothesis, so that no number drowns the others.
    along = [
        (leaf if i < len(numbers) else jnp.ones_like(leaf))
        * jax.random.normal(k, leaf.shape)
        for i, (k, leaf) in enumerate(zip(keys, leaves, strict=True))
    ]

    def run(numbers, state, wrench):
        # Off the pin the two paths differ: one puts a state back before the step.
        return run_step(*on_the_pin(join(numbers), state), wrench, ONE_FOOT, SHORT)

    return run, inputs, jax.tree.unflatten(treedef, along)


def forward(params, state, wrench, key):
    """Derivative along a random direction."""
    return jax.jvp(*inputs_and_direction(params, state, wrench, key))[1]


def backward(params, state, wrench, key):
    """Inner product of that derivative with the ramp 1, 2, ..., by reverse mode."""
    run, inputs, direction = inputs_and_direction(params, state, wrench, key)
    end, pull = jax.vjp(run, *inputs)
    pulled = pull(jnp.arange(1.0, 1.0 + end.size).reshape(end.shape))
    pairs = zip(jax.tree.leaves(pulled), jax.tree.leaves(direction), strict=True)
    return sum(jnp.sum(a * b) for a, b in pairs)


@pytest.mark.slow
def test_derivatives_agree_between_modes_and_paths():
    cases = *draws(seed=2), jax.random.split(jax.random.key(3), NUM_CASES)
    rate = np.asarray(jax.jit(jax.vmap(forward))(*cases)).reshape(NUM_CASES, -1)
    total = np.asarray(jax.jit(jax.vmap(backward))(*cases))
    scale = np.max(np.abs(rate), axis=1)
    along_ramp = rate @ np.arange(1.0, 1.0 + rate.shape[1])
    np.testing.assert_allclose((along_ramp - total) / scale, 0.0, atol=1e-9)
    slow = OnGeneralPath(jax.vmap(forward))(*cases)
    difference = worst_of_each(rate, np.reshape(slow, rate.shape)) / scale
    assert np.quantile(difference, 0.99) < 1e-6

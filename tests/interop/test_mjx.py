"""Batched MJX models move as MuJoCo does with each draw's own document."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.interop import brax_randomisation, randomise_mjx, to_mjcf
from tests.interop.mjcf_worlds import ball, box, joint, scene

NUM_DRAWS, TIME_STEP = 3, 0.002
FACTORS = np.array([1.0, 1.3, 0.6])


def arm(**friction):
    """A pendulum on a drawer, and a cart on a wheel."""
    bodies = [
        box("drawer", (0.0, 0.0, 0.0), half=(0.2, 0.1)),
        box("pole", (0.0, -0.3, 0.4), half=(0.05, 0.3)),
        box("cart", (2.0, 0.0, 0.3), twist=[1.0, -0.4, 0.5]),
    ]
    return scene(
        bodies,
        joint("prismatic", "drawer", "world", (0, 0), (0, 0), axis=0.2, viscous=0.5),
        joint("revolute", "pole", "drawer", (0, 0.3), (0, 0), viscous=0.02),
        {"type": "wheel", "a": "cart", "pose": [-0.2, 0, 0.1], **friction},
    )


def batch(spec):
    """Draws in which masses, frictions, anchors and wheels differ."""
    params = spec.params()
    draws = jax.tree.map(lambda leaf: jnp.stack([leaf] * NUM_DRAWS), params)
    scale = jnp.asarray(FACTORS)
    density = draws.density * scale[:, None]
    pins, wheel = draws.revolute, draws.wheel
    return dataclasses.replace(
        draws,
        density=density,
        revolute=dataclasses.replace(
            pins,
            anchor_a=pins.anchor_a * scale[:, None, None],
            viscous=pins.viscous * scale[:, None],
            dry=pins.dry * scale[:, None],
        ),
        wheel=dataclasses.replace(
            wheel,
            position=wheel.position * scale[:, None, None, None],
            heading=wheel.heading + scale[:, None, None],
            viscous=wheel.viscous * scale[:, None, None, None],
        ),
    )


def one_of(draws, index):
    return jax.tree.map(lambda leaf: leaf[index], draws)


def document(spec, draws, index=0, **options):
    return to_mjcf(spec, one_of(draws, index), time_step=TIME_STEP, **options)


def run_mjx(model, axes, text, num_steps):
    """Joint coordinates of every draw after each step."""
    key = mujoco.MjModel.from_xml_string(text).key("start")

    def run(one):
        data = mjx.make_data(one)
        data = data.replace(qpos=jnp.asarray(key.qpos), qvel=jnp.asarray(key.qvel))

        def advance(data, _):
            after = mjx.step(one, data)
            # In 64 bit MJX changes the type of a tendon's indices.
            after = jax.tree.map(lambda new, old: new.astype(old.dtype), after, data)
            return after, after.qpos

        return jax.lax.scan(advance, data, None, length=num_steps)[1]

    # MJX adds vectors to matrices.
    with jax.numpy_rank_promotion("allow"):
        return np.asarray(jax.jit(jax.vmap(run, in_axes=(axes,)))(model))


def run_mujoco(text, start, num_steps):
    """Joint coordinates after each step, from the key frame of another document."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    key = mujoco.MjModel.from_xml_string(start).key("start")
    data.qpos[:], data.qvel[:] = key.qpos, key.qvel
    path = []
    for _ in range(num_steps):
        mujoco.mj_step(model, data)
        path.append(data.qpos.copy())
    return np.array(path)


def put(text):
    return mjx.put_model(mujoco.MjModel.from_xml_string(text))


def assert_moves_as_documents(spec, draws, num_steps, *, atol, **options):
    start = document(spec, draws, **options)
    model, axes = randomise_mjx(put(start), spec, draws)
    ours = run_mjx(model, axes, start, num_steps)
    theirs = [
        run_mujoco(document(spec, draws, i, **options), start, num_steps)
        for i in range(NUM_DRAWS)
    ]
    assert np.max(np.abs(theirs[0] - theirs[1])) > 1e-3
    np.testing.assert_allclose(ours, theirs, atol=atol, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "atol"), [("implicitfast", 5e-3), ("Euler", 1e-7)]
)
def test_draws_move_as_their_documents(integrator, atol):
    # From this step MuJoCo leaves out how a wheel couples directions; MJX does not.
    spec = arm(viscous=[0.3, 8.0])
    draws = batch(spec)
    assert_moves_as_documents(spec, draws, 200, atol=atol, integrator=integrator)


@pytest.mark.slow
def test_slipping_wheels_move_as_their_documents():
    spec = arm(viscous=[0.3, 80.0], dry=[1.0, 2.0])
    draws = batch(spec)
    assert_moves_as_documents(spec, draws, 200, atol=1e-7, integrator="Euler")


@pytest.mark.slow
def test_soft_constraints_move_as_in_their_documents():
    pin = joint("revolute", "box", "world", (-0.3, 0), (0, 0), dry=0.5, lower=-0.6)
    rod = joint("distance", "ball", "world", (0, 0), (1, 0.4), length=0.4)
    spec = scene([box("box", (0.3, 0, 0)), ball("ball", (1.3, 0.3, 0))], pin, rod)
    assert_moves_as_documents(spec, batch(spec), 150, atol=2e-3)


def test_fields_are_those_of_each_document():
    spec = arm(viscous=[0.3, 8.0])
    draws = batch(spec)
    model, axes = randomise_mjx(put(document(spec, draws)), spec, draws)
    for i in range(NUM_DRAWS):
        own = mujoco.MjModel.from_xml_string(document(spec, draws, i))
        for field in ("body_mass", "body_inertia", "jnt_pos", "dof_damping"):
            rows = getattr(model, field)
            assert getattr(axes, field) == 0
            np.testing.assert_allclose(rows[i], getattr(own, field), rtol=1e-12)
        np.testing.assert_allclose(model.actuator_biasprm[i], own.actuator_biasprm)
        np.testing.assert_allclose(model.body_invweight0[i], own.body_invweight0)
    assert axes.geom_pos is None
    mass = 20.0 * 4 * 0.05 * 0.3
    index = own.body("pole").id
    np.testing.assert_allclose(model.body_mass[:, index], mass * FACTORS, rtol=1e-12)


def test_elements_of_the_users_own_stay():
    spec = arm(viscous=[0.3, 8.0])
    draws = batch(spec)
    text = document(spec, draws)
    first = '<body name="mine" pos="9 9 0"><freejoint/><geom size="0.1"/></body>'
    text = text.replace("<worldbody>", f"<worldbody>{first}").split("<keyframe>")[0]
    model, _ = randomise_mjx(put(f"{text}</mujoco>"), spec, draws)
    own = mujoco.MjModel.from_xml_string(document(spec, draws, 1))
    np.testing.assert_allclose(model.body_mass[1, 2:], own.body_mass[1:])
    assert np.ptp(model.body_mass[:, 1]) == 0 < model.body_mass[0, 1]
    np.testing.assert_allclose(model.dof_damping[1, 6:], own.dof_damping)


def posterior(spec, draws, weights):
    num_bodies = spec.num_bodies
    return Posterior(
        params=draws,
        noise_scale=jnp.ones((NUM_DRAWS, num_bodies, 4)),
        log_weight=jnp.log(jnp.asarray(weights)),
        log_density=jnp.zeros(NUM_DRAWS),
        chain=jnp.zeros(NUM_DRAWS, int),
        prior_params=draws,
        prior_noise_scale=jnp.ones((NUM_DRAWS, num_bodies, 4)),
        inferred={},
        spec=spec,
    )


def test_posterior_gives_its_draws_by_weight():
    spec = arm(viscous=[0.3, 8.0])
    draws = batch(spec)
    belief = posterior(spec, draws, [0.0005, 0.999, 0.0005])
    model, _ = randomise_mjx(put(document(spec, draws)), spec, belief, num_draws=2)
    # Both are the probable draw, so that nothing has an axis.
    own = mujoco.MjModel.from_xml_string(document(spec, draws, 1))
    np.testing.assert_allclose(model.body_mass, own.body_mass)


def test_every_environment_gets_a_draw():
    spec = arm(viscous=[0.3, 8.0])
    draws = batch(spec)
    randomise = brax_randomisation(spec, draws)
    keys = jax.random.split(jax.random.key(0), 64)
    system, axes = randomise(put(document(spec, draws)), keys)
    assert axes.body_mass == 0
    assert system.body_mass.shape[0] == 64
    index = mujoco.MjModel.from_xml_string(document(spec, draws)).body("pole").id
    drawn = np.unique(np.round(system.body_mass[:, index] / (20 * 4 * 0.05 * 0.3), 9))
    np.testing.assert_allclose(drawn, np.sort(FACTORS))


def test_equal_draws_need_no_axis():
    spec = arm(viscous=[0.3, 8.0])
    draws = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), spec.params())
    base = put(document(spec, draws))
    system, axes = brax_randomisation(spec, draws)(
        base, jax.random.split(jax.random.key(1))
    )
    assert jax.tree.leaves(axes) == []
    np.testing.assert_array_equal(system.body_mass, base.body_mass)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.filterwarnings("ignore:Brax System:UserWarning")
def test_brax_environments_fall_as_their_draws_do():
    from brax.envs.base import PipelineEnv, State
    from brax.envs.wrappers.training import DomainRandomizationVmapWrapper
    from brax.io import mjcf

    pin = joint("revolute", "pole", "world", (-0.3, 0), (0, 0))
    spec = scene([box("pole", (0.3, 0, 0))], pin)
    draws = batch(spec)

    class Pole(PipelineEnv):
        def reset(self, rng):
            state = self.pipeline_init(jnp.zeros(1), jnp.zeros(1))
            return State(state, state.q, jnp.zeros(()), jnp.zeros(()))

        def step(self, state, action):
            after = self.pipeline_step(state.pipeline_state, action)
            return state.replace(pipeline_state=after, obs=after.q)

    with jax.numpy_rank_promotion("allow"):
        system = mjcf.loads(document(spec, draws))
        env = Pole(system, backend="mjx", n_frames=1)
        keys = jax.random.split(jax.random.PRNGKey(0), 8)
        randomise = brax_randomisation(spec, draws)
        wrapped = DomainRandomizationVmapWrapper(env, lambda sys: randomise(sys, keys))
        state = jax.jit(wrapped.reset)(keys)
        advance = jax.jit(wrapped.step)
        for _ in range(50):
            state = advance(state, jnp.zeros((8, 0)))
    chosen = [int(jax.random.randint(key, (), 0, NUM_DRAWS)) for key in keys]
    assert len(set(chosen)) > 1
    start = document(spec, draws)
    for own, index in zip(np.asarray(state.obs), chosen, strict=True):
        path = run_mujoco(document(spec, draws, index), start, 50)
        np.testing.assert_allclose(own, path[-1], atol=1e-5)


def refused(message, draws, spec, text=None):
    model = put(document(spec, draws) if text is None else text)
    with pytest.raises(ValueError, match=message):
        randomise_mjx(model, spec, draws)


def test_one_hypothesis_is_refused():
    spec = arm(viscous=[0.3, 8.0])
    text = to_mjcf(spec, spec.params())
    refused(
        "draws: expected hypotheses with one leading axis", spec.params(), spec, text
    )


def test_a_model_for_the_host_is_refused():
    spec = arm(viscous=[0.3, 8.0])
    draws = batch(spec)
    model = mujoco.MjModel.from_xml_string(document(spec, draws))
    with pytest.raises(ValueError, match=r"expected a mujoco.mjx.Model .* got MjModel"):
        randomise_mjx(model, spec, draws)


def test_a_posterior_of_other_outlines_is_refused():
    spec, wide = (scene([box("a", (0, 0, 0), half=(x, 0.1))]) for x in (0.2, 2.0))
    belief = posterior(wide, batch(wide), [0.2, 0.3, 0.5])
    text = to_mjcf(spec, spec.params())
    refused("draws: body 'a': shape.half_extents: expected", belief, spec, text)


def test_several_structures_are_refused():
    spec = arm(viscous=[0.3, 8.0])
    draws = batch(spec)
    active = draws.wheel.active.at[1].set(False)
    draws = dataclasses.replace(
        draws, wheel=dataclasses.replace(draws.wheel, active=active)
    )
    refused("draws: expected one structure, .* cart.wheel0", draws, spec)


def test_model_of_something_else_is_refused():
    spec = arm(viscous=[0.3, 8.0])
    other = scene([box("other", (0, 0, 0))])
    text = to_mjcf(other, other.params())
    refused("model: expected one of the document .* 'drawer'", batch(spec), spec, text)


def test_change_of_what_is_compiled_is_refused():
    spec = arm(viscous=[0.3, 8.0], dry=[1.0, 2.0])
    draws = batch(spec)
    dry = draws.wheel.dry.at[2].set(jnp.inf)
    draws = dataclasses.replace(draws, wheel=dataclasses.replace(draws.wheel, dry=dry))
    refused("actuator_forcelimited of 'cart.wheel0.rolling'", draws, spec)
    spec = arm(viscous=[0.3, 8.0])
    draws = batch(spec)
    pins = dataclasses.replace(
        draws.revolute,
        viscous=draws.revolute.viscous.at[1].set(25.0),
        dry=draws.revolute.dry.at[1].set(0.5),
    )
    draws = dataclasses.replace(draws, revolute=pins)
    refused("dof_frictionloss above 0 of 'pole.pin'", draws, spec)

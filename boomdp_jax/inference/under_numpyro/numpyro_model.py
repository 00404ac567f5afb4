r"""The paper's equations 1 to 3 as an ordinary NumPyro model, for one structure.

$$\Phi, \sigma \sim P(\Phi)\, P(\sigma), \qquad
  s'_t \sim \mathrm{Normal}(F_\Phi(s_t, a_t),\, \sigma),$$

with the priors of `prior.py` (Scholz et al. (2014), A Physics-Based Model Prior for
Object-Oriented MDPs, section 4). Every handler of NumPyro works on it: `Predictive`,
`SVI`, `NUTS`, `condition`, `substitute`. To infer which constraints exist, use
`structure_kernel` or `infer`.

For a run of your own, `NUTS(model, dense_mass=True, regularize_mass_matrix=False)`:
NumPyro's regularised mass matrix is a hundred times too wide for anchors. `run_nuts`
also starts from fitted modes, which pins and wheels need.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Bool, Float
from numpyro.distributions import transforms

from boomdp_jax.core.history import History
from boomdp_jax.inference.arguments import check_history, check_spec
from boomdp_jax.inference.blocks.block import Block
from boomdp_jax.inference.blocks.fixed_structure import Structure, structure_blocks
from boomdp_jax.inference.blocks.model_sites import Site, block_sites
from boomdp_jax.inference.hypotheses.contact_prediction import (
    ContactScene,
    predict_step,
)
from boomdp_jax.inference.hypotheses.prior import NOISE_GROUPS
from boomdp_jax.inference.hypotheses.slot_names import known_numbers, physical_numbers
from boomdp_jax.inference.likelihoods.one_step import NOISE_SHAPE
from boomdp_jax.inference.readings.single_steps import Readings, in_effect, readings
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_spec import SceneSpec

# Channel group of x, y, theta, xdot, ydot, thetadot.
_GROUP = (0, 0, 1, 2, 2, 3)


class ObjectModel(eqx.Module):
    """A NumPyro model of the bodies of a scene that can move; made by `make_model`.

    Sample sites, by body and constraint: `table.density` [kg/m²];
    `table.center_of_mass` [m], `table.actuator.gain`, `bias` [N, N, N m] and `delay`
    [s] where they are unknown;
    `table.revolute.anchor_a` [m], `offset` of the pin from where the readings have that
    point [m], `viscous_rate` [1/s], `dry_share`; `table.distance.anchor_a`, `anchor_b`
    [m], `length_ratio` to their distance at the first reading; `table.prismatic.axis`
    [rad] (to be read modulo half a turn), `offset` of the line from where the body was
    seen [m], `angle` [rad],
    `viscous_rate` [1/s], `dry_share`; `table.weld.offset` [m], `angle` [rad];
    `table.wheel.position` [m], `heading` [rad] (to be read modulo half a turn),
    `lateral_rate` [1/s], `lateral_limit`, `viscous_ratio`, `dry_ratio`, `half_track`
    [m]; `table.ground.dry`, `knee_speed` [m/s], `torque_share`, `load_shift` [m]
    and, where the scene gives no feet, `stance_scale` and `corner_share`, where it
    does not give three, `diagonal_share`. A joint
    between two bodies is `cart.revolute_to_pole`. Rates, shares, limits and ratios are
    relative to mass and weight, as `prior.py` has them. Noise is
    `noise.position` [m], `noise.angle` [rad], `noise.velocity` [m/s], `noise.spin`
    [rad/s], one number per body, or the single `noise`.

    Deterministic sites: `table.mass` [kg], `table.revolute.anchor_b` and
    `table.distance.length` [m], and the coefficients in SI units,
    `table.revolute.viscous`, `table.wheel.viscous`, `table.ground.viscous`, `...dry`.

    The observed site `next_state`, `[time, body, 6]`, has the bodies in `bodies`.
    """

    blocks: tuple[Block, ...]
    """Bodies that do not interact with those of other blocks."""
    block_names: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    """Names of each block's bodies."""
    sites: tuple[tuple[Site, ...], ...]
    """Sample sites of each block, noise left out."""
    given: frozenset[str] = eqx.field(static=True)
    """Physical numbers that are known, and so not recorded."""
    noise: str = eqx.field(static=True)

    @property
    def bodies(self) -> tuple[int, ...]:
        """Places in the scene of the bodies that are modelled, ascending."""
        return tuple(sorted(i for block in self.blocks for i in block.bodies))

    @property
    def noise_scale(self) -> Float[Array, " 4"]:
        """Scale of the prior of each noise group [m, rad, m/s, rad/s]."""
        likelihood: Any = self.blocks[0].target.log_likelihood
        return likelihood.coordinates.scales.noise

    def __call__(
        self, history: History | None = None, *, is_observed: bool = True
    ) -> None:
        """Run the model.

        Args:
            history: states and actions to predict from, and what followed; default:
                the history that the model was made with. Prior scales stay those of
                that one.
            is_observed: whether the recorded next states are conditioned on. If not,
                they are drawn: `Predictive(model, num_samples=100)(key,
                is_observed=False)` gives prior predictions.
        """
        data = [self._readings(block, history) for block in self.blocks]
        num_rows = data[0].state.shape[0]
        bodies = np.asarray(self.bodies)
        each_body = numpyro.plate("body", len(bodies), dim=-1)
        scale = self._sample_noise(each_body)
        shape = (num_rows, len(bodies), 6)
        predicted, read, counts = (jnp.zeros(shape) for _ in range(3))
        for number, block in enumerate(self.blocks):
            params = self._sample_params(number)
            place = np.searchsorted(bodies, block.bodies)
            likelihood: Any = block.target.log_likelihood
            prediction = _predict(likelihood.coordinates.world, params, data[number])
            predicted = predicted.at[:, place].set(prediction)
            read = read.at[:, place].set(data[number].next_state)
            counts = counts.at[:, place].set(data[number].mask)
        each_row = numpyro.plate("time", num_rows, dim=-2)
        with each_row, each_body:
            normal: Any = dist.Normal(predicted, scale)
            numpyro.sample(
                "next_state",
                normal.mask(counts > 0).to_event(1),
                obs=_nearest_turn(read, predicted) if is_observed else None,
            )

    def _sample_noise(self, each_body: numpyro.plate) -> Float[Array, "1 body 6"]:
        """Noise scale of every channel."""
        num_bodies = len(self.bodies)
        if self.noise == "scalar":
            # One number for metres and radians; the prior's scales meet in the middle.
            middle = jnp.exp(jnp.mean(jnp.log(self.noise_scale)))
            scale = numpyro.sample("noise", noise_prior(middle))
            return jnp.broadcast_to(scale, (1, num_bodies, 6))
        with each_body:
            scales = [
                numpyro.sample(f"noise.{group}", noise_prior(scale))
                for group, scale in zip(NOISE_GROUPS, self.noise_scale, strict=True)
            ]
        return jnp.stack([scales[group] for group in _GROUP], axis=-1)[None]

    def _sample_params(self, number: int) -> Params:
        """Sample the hypothesis of one block, and record it in SI units."""
        block, sites = self.blocks[number], self.sites[number]
        likelihood: Any = block.target.log_likelihood
        coordinates = likelihood.coordinates
        z = jnp.zeros(block.layout.dim)
        for site in sites:
            value = jnp.asarray(numpyro.sample(site.name, site.prior))
            z = z.at[jnp.asarray(site.coordinates)].set(site.to_coordinates(value))
        params = coordinates(z, jnp.ones(len(block.layout.slots), bool))
        numbers = physical_numbers(
            self.block_names[number], block.layout, params, coordinates.scene.area
        )
        skipped = self.given | {site.name for site in sites}
        for name, number_value in numbers.items():
            if name not in skipped:
                numpyro.deterministic(name, number_value)
        return params

    def _readings(self, block: Block, history: History | None) -> Readings:
        if history is None:
            likelihood: Any = block.target.log_likelihood
            return likelihood.data.steps
        has_delay = block.layout.has_delay
        return readings(history, block.bodies, is_uniform=False, has_delay=has_delay)


def make_model(
    spec: SceneSpec,
    history: History,
    structure: Structure | Bool[np.ndarray, " slot"] | None = None,
    *,
    noise: str = "groups",
) -> ObjectModel:
    """Build the model of a scene in which a structure holds.

    Args:
        spec: the scene: outlines, what is known, what may exist.
        history: recorded transitions; the prior of places is scaled by how far the
            bodies moved in them.
        structure: constraints that exist besides the known ones, by body:
            `{"table": ["revolute"]}`, `{"cart": ["wheel", ("revolute", "pole")]}`, or
            which slots of `scene_layout(spec)` are active. Default: none.
        noise: `groups`, a scale for position, angle, velocity and spin of each body,
            or `scalar`, the paper's single scale for all.

    Returns:
        The model.

    Raises:
        TypeError: a scene or history that is none.
        ValueError: a structure that the scene does not allow, an unknown kind of
            noise, a history of another number of bodies, or no body that can move.
    """
    if noise not in ("groups", "scalar"):
        raise ValueError(f"noise: expected groups or scalar, got {noise!r}")
    check_spec(spec)
    check_history(spec, history)
    if np.all(spec.is_static):
        raise ValueError(f"{spec.source}: expected a body that can move, got none")
    blocks = structure_blocks(spec, history, structure)
    return model_of_blocks(blocks, spec.names, noise)


def model_of_blocks(
    blocks: list[Block], names: tuple[str, ...], noise: str = "groups"
) -> ObjectModel:
    """The model of some blocks of a scene.

    Args:
        blocks: as `structure_blocks` makes them.
        names: of the scene's bodies.
        noise: as in `make_model`.
    """
    block_names = [tuple(names[i] for i in block.bodies) for block in blocks]
    given: set[str] = set()
    for block, mine in zip(blocks, block_names, strict=True):
        likelihood: Any = block.target.log_likelihood
        around = likelihood.coordinates.surroundings
        given |= known_numbers(mine, block.layout, around.known, around.density)
    return ObjectModel(
        blocks=tuple(blocks),
        block_names=tuple(block_names),
        sites=tuple(map(block_sites, blocks, block_names)),
        given=frozenset(given),
        noise=noise,
    )


def noise_prior(scale: Float[Array, ""]) -> dist.Distribution:
    """Distribution of a noise scale whose square is inverse-gamma.

    Args:
        scale: square root of the rate; the shape is `NOISE_SHAPE`.
    """
    return dist.TransformedDistribution(
        dist.Gamma(NOISE_SHAPE, scale**2), transforms.PowerTransform(-0.5)
    )


def _predict(
    scene: Scene | ContactScene, params: Params, data: Readings
) -> Float[Array, "time body 6"]:
    """Where every recorded step should end."""

    def one(state: Array, action: Array, dt: Array) -> Array:
        return predict_step(scene, params, state, action, dt)

    in_axes = (0, 0, 0 if data.dt.ndim else None)
    return jax.vmap(one, in_axes)(data.state, in_effect(params, data), data.dt)


def _nearest_turn(
    read: Float[Array, "time body 6"], predicted: Float[Array, "time body 6"]
) -> Float[Array, "time body 6"]:
    """Readings with angles moved by whole turns to where they were predicted."""
    turn = 2.0 * jnp.pi
    turns = jnp.round((predicted[..., 2] - read[..., 2]) / turn)
    return read.at[..., 2].add(turn * jax.lax.stop_gradient(turns))

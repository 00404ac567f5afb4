r"""An ensemble of small networks, each shown its own resample of what was seen.

Every member maps standardised inputs to targets in units of their size through two
hidden layers, and says mean and log-variance of each; all descend the negative
log-likelihood of a normal, over rows weighted by how often a bootstrap draws them
(Chua, Calandra, McAllister and Levine 2018, Deep reinforcement learning in a handful of
trials, "PETS"). Where rows are few members disagree. The last layer begins at zero, so
that nothing known means coasting.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PyTree

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, Key
from boomdp_jax.models.regression import AbstractRegressor
from boomdp_jax.models.table import (
    Scaling,
    Table,
    add_row,
    check_at_least,
    empty_table,
    scaling_of,
    size_of,
)

# Bounds that a member's log-variance bends to: a thousandth of a target's size, to it.
_LOG_VARIANCE = (-14.0, 1.0)
# Distribution of a Poisson number of mean one: how often a bootstrap draws a row.
_DRAWN_AT_MOST = np.cumsum([math.exp(-1) / math.factorial(k) for k in range(6)])
_WEIGHT_DECAY, _LONGEST_GRADIENT = 1e-5, 10.0


class Layer(eqx.Module):
    """An affine map; a network is a tuple of them."""

    weight: Float[Array, "*batch into out"]
    offset: Float[Array, "*batch out"]


class EnsembleFit(eqx.Module):
    """Rows, how often each member sees them, and the members."""

    table: Table
    num_drawn: Int[Array, "*batch row member"]
    members: PyTree
    """Layers, with an axis `member`."""
    optimiser: PyTree
    key: Key
    """For the next resample and minibatches."""


class Member(eqx.Module):
    """One network and the units that it speaks in."""

    layers: PyTree
    scaling: Scaling
    size: Float[Array, "*batch output"]


class NeuralEnsemble(AbstractRegressor):
    """Bootstrapped networks, one hypothesis each, trained a little with every row.

    For many rows of many numbers: predictions cost the same however many there were.
    With few rows the other regressions are better.
    """

    num_members: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    capacity: int = eqx.field(static=True)
    num_steps: int = eqx.field(static=True)
    batch_size: int = eqx.field(static=True)
    learning_rate: float = eqx.field(static=True)
    is_probabilistic: bool = eqx.field(static=True)
    is_noisy: bool = eqx.field(static=True)

    def __init__(
        self,
        *,
        num_members: int = 5,
        width: int = 64,
        capacity: int = 2000,
        num_steps: int = 20,
        batch_size: int = 64,
        learning_rate: float = 2e-3,
        is_probabilistic: bool = True,
        is_noisy: bool = False,
    ):
        """Settings.

        Args:
            num_members: networks.
            width: numbers in each of two hidden layers.
            capacity: newest rows that are kept.
            num_steps: minibatches with every row.
            batch_size: rows in each.
            learning_rate: of Adam.
            is_probabilistic: whether members learn a variance; else squared error.
            is_noisy: whether predictions are drawn with that variance.

        Raises:
            ValueError: a count below one, a learning rate that is not positive, or
                noise without a variance.
        """
        for name, value in (
            ("num_members", num_members),
            ("width", width),
            ("capacity", capacity),
            ("num_steps", num_steps),
            ("batch_size", batch_size),
        ):
            check_at_least(name, value, 1)
        if not learning_rate > 0:
            raise ValueError(
                f"learning_rate: expected a positive number, got {learning_rate}"
            )
        if is_noisy and not is_probabilistic:
            raise ValueError(
                "is_noisy: expected only of members that learn a variance, got "
                "is_probabilistic=False"
            )
        self.num_members = num_members
        self.width = width
        self.capacity = capacity
        self.num_steps = num_steps
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.is_probabilistic = is_probabilistic
        self.is_noisy = is_noisy

    @property
    def _optimiser(self) -> optax.GradientTransformation:
        return optax.chain(
            optax.clip_by_global_norm(_LONGEST_GRADIENT),
            optax.adamw(self.learning_rate, weight_decay=_WEIGHT_DECAY),
        )

    def init(self, key: Key, num_inputs: int, num_outputs: int) -> EnsembleFit:
        """No rows, and members that say zero."""
        member_key, later_key = jax.random.split(key)
        num_last = 2 * num_outputs if self.is_probabilistic else num_outputs
        sizes = (num_inputs, self.width, self.width, num_last)
        members = jax.vmap(lambda one: _network(one, sizes))(
            jax.random.split(member_key, self.num_members)
        )
        return EnsembleFit(
            table=empty_table(self.capacity, num_inputs, num_outputs),
            num_drawn=jnp.zeros((self.capacity, self.num_members), jnp.int32),
            members=members,
            optimiser=jax.vmap(self._optimiser.init)(members),
            key=later_key,
        )

    def add(
        self,
        fit: EnsembleFit,
        inputs: Float[Array, " input"],
        targets: Float[Array, " output"],
        is_seen: BoolScalar,
    ) -> EnsembleFit:
        """Take one row in, as often as each member's bootstrap draws it."""
        draw_key, later_key = jax.random.split(fit.key)
        place = fit.table.num_seen % self.capacity
        uniform = jax.random.uniform(draw_key, (self.num_members, 1))
        limits = jnp.asarray(_DRAWN_AT_MOST[None], uniform.dtype)
        drawn = jnp.sum(uniform > limits, axis=1).astype(jnp.int32)
        drawn = jnp.where(is_seen, drawn, fit.num_drawn[place])
        return EnsembleFit(
            table=add_row(fit.table, inputs, targets, is_seen),
            num_drawn=fit.num_drawn.at[place].set(drawn),
            members=fit.members,
            optimiser=fit.optimiser,
            key=later_key,
        )

    def is_due(self, fit: EnsembleFit) -> BoolScalar:
        """Always, from the first row on."""
        return fit.table.num_seen > 0

    def tune(self, fit: EnsembleFit) -> EnsembleFit:
        """Some steps of descent, on minibatches of each member's own."""
        table = fit.table
        batch_key, later_key = jax.random.split(fit.key)
        points = scaling_of(table.inputs, table.mask)(table.inputs)
        targets = size_of(table.targets, table.mask)(table.targets)
        num_rows = jnp.maximum(table.num_rows, 1)
        optimiser = self._optimiser

        def move(carry: tuple, index: Int[Array, " batch"], drawn: Array) -> tuple:
            member, state = carry
            gradient = jax.grad(self._loss)(
                member, points[index], targets[index], drawn[index]
            )
            step, state = optimiser.update(gradient, state, member)
            return optax.apply_updates(member, step), state

        def one_step(carry: tuple, key: Key) -> tuple[tuple, None]:
            shape = (self.num_members, self.batch_size)
            index = jax.random.randint(key, shape, 0, num_rows)
            return jax.vmap(move, in_axes=(0, 0, 1))(carry, index, fit.num_drawn), None

        (members, state), _ = jax.lax.scan(
            one_step,
            (fit.members, fit.optimiser),
            jax.random.split(batch_key, self.num_steps),
        )
        return EnsembleFit(table, fit.num_drawn, members, state, later_key)

    def prepare(self, fit: EnsembleFit) -> Member:
        """All members."""
        scaling = scaling_of(fit.table.inputs, fit.table.mask)
        size = size_of(fit.table.targets, fit.table.mask).spread
        units = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf[None], (self.num_members, *leaf.shape)),
            (scaling, size),
        )
        return Member(fit.members, *units)

    def predict(
        self, key: Key, hypothesis: Member, inputs: Float[Array, " input"]
    ) -> Float[Array, " output"]:
        """A member's mean, or a draw with its variance."""
        point = hypothesis.scaling(inputs)
        mean, log_variance = self._read(_forward(hypothesis.layers, point))
        if self.is_noisy:
            sd = jnp.exp(0.5 * log_variance)
            mean = mean + sd * jax.random.normal(key, mean.shape, mean.dtype)
        return mean * hypothesis.size

    def _loss(
        self,
        member: PyTree,
        points: Float[Array, "row input"],
        targets: Float[Array, "row output"],
        num_drawn: Int[Array, " row"],
    ) -> FloatScalar:
        """Negative log-likelihood, or half the squared error, per row drawn."""
        mean, log_variance = jax.vmap(
            lambda point: self._read(_forward(member, point))
        )(points)
        square = (mean - targets) ** 2 * jnp.exp(-log_variance)
        each = 0.5 * jnp.sum(square + log_variance, axis=1)
        return jnp.sum(num_drawn * each) / len(points)

    def _read(
        self, numbers: Float[Array, " last"]
    ) -> tuple[Float[Array, " output"], Float[Array, " output"]]:
        """Mean and log-variance, in units of the targets' size."""
        if not self.is_probabilistic:
            return numbers, jnp.zeros_like(numbers)
        mean, free = jnp.split(numbers, 2)
        low, high = _LOG_VARIANCE
        return mean, low + jax.nn.softplus(high - low - jax.nn.softplus(high - free))


def _network(key: Key, sizes: tuple[int, ...]) -> PyTree:
    """Layers that keep the spread of what they see; the last one says zero."""
    keys = jax.random.split(key, len(sizes) - 1)
    spread = [into**-0.5 for into in sizes[:-2]] + [0.0]
    return tuple(
        Layer(s * jax.random.normal(k, (into, out)), jnp.zeros(out))
        for k, s, into, out in zip(keys, spread, sizes[:-1], sizes[1:], strict=True)
    )


def _forward(layers: PyTree, point: Float[Array, " input"]) -> Array:
    """Through all layers, with the swish of Ramachandran et al. (2017) in between."""
    # At the default precision of the device: members differ by more than it rounds.
    *hidden, last = layers
    for layer in hidden:
        point = jax.nn.swish(point @ layer.weight + layer.offset)
    return point @ last.weight + last.offset

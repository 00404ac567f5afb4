"""A mixture over structures and coordinates to propose from: t bumps at fitted modes.

Every component belongs to one structure. Its coordinates follow a multivariate Student
distribution, but for those marked `from_prior`, which follow the target's prior.

An angle's Student distribution is cut off half a period from the component's mean, and
the mass beyond is given up, not folded back. The density is then a single term, exact
to rounding, and integrates to a little less than one. A draw that falls outside says
so; a Metropolis move then stays, an importance sampler gives it no weight. Both remain
exact. Where an angle is hardly known, mark it `from_prior`: nothing is lost.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import gammaln, logsumexp
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, Key
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.core.random_numbers import Noise, draw_noise, pick
from boomdp_jax.inference.likelihoods.target import StructureTarget


class MixtureDraw(NamedTuple):
    """A structure with coordinates; worthless unless `is_inside`."""

    structure: IntScalar
    z: Float[Array, " dim"]
    is_inside: BoolScalar


class LaplaceMixture(eqx.Module):
    """Student components, one structure each; made by `make_mixture`.

    Rows and columns of coordinates that a component does not draw from its Student
    distribution are those of the identity, and their mean is zero. A component with a
    log-weight of minus infinity is padding.
    """

    structure: Int[Array, " component"]
    mean: Float[Array, "component dim"]
    scale_tril: Float[Array, "component dim dim"]
    log_weight: Float[Array, " component"]
    """Normalised."""
    from_prior: Bool[Array, "component dim"]
    """Coordinates that follow the target's prior, independently of all others."""
    is_student: Bool[Array, "component dim"]
    """Coordinates that follow the Student distribution."""
    whitening: Float[Array, "component dim dim"]
    """Inverse of `scale_tril`."""
    log_normaliser: Float[Array, " component"]
    """Log-density of the Student part at its mean."""
    block_tril: Float[Array, "component dim dim"]
    """Cholesky factor of the precision of each slot's coordinates given all others."""
    block_whitening: Float[Array, "component dim dim"]
    """Inverse of `block_tril`."""
    members: Int[Array, "structure member"] | None = None
    """Components of each structure, padded with -1; None: not known."""
    degrees_of_freedom: int = eqx.field(static=True, default=6)

    @property
    def num_components(self) -> int:
        """How many components there are, padding included."""
        return self.structure.shape[-1]

    @property
    def most_each(self) -> int | None:
        """For how many components of a structure there is room; None: not known."""
        return None if self.members is None else self.members.shape[-1]

    def sample(self, key: Key, target: StructureTarget) -> MixtureDraw:
        """Draw a structure and its coordinates."""
        noise = draw_noise(key, target.dim, self.degrees_of_freedom)
        component = pick(self.log_weight, noise.choice[0])
        return self.sample_component(noise, target, component)

    @full_precision
    def sample_component(
        self, noise: Noise, target: StructureTarget, component: IntScalar
    ) -> MixtureDraw:
        """Turn random numbers into coordinates of one component."""
        is_student = self.is_student[component]
        chi_square = noise.chi_square(self.degrees_of_freedom)
        spread = jnp.sqrt(self.degrees_of_freedom / chi_square)
        normal = jnp.where(is_student, noise.normal, 0.0)
        offset = spread * (self.scale_tril[component] @ normal)
        prior = jnp.where(self.from_prior[component], prior_draw(noise, target), 0.0)
        z = jnp.where(is_student, self.mean[component] + offset, prior)
        is_inside = is_in_cell(target, offset, is_student)
        return MixtureDraw(self.structure[component], target.wrap(z), is_inside)

    def log_density(
        self, target: StructureTarget, structure: IntScalar, z: Float[Array, " dim"]
    ) -> FloatScalar:
        """Log-density of a structure and its coordinates."""
        own = self.of_structure(structure)
        return logsumexp(own.component_log_density(target, structure, z))

    def of_structure(self, structure: IntScalar) -> "LaplaceMixture":
        """The components of a structure alone, where it is known which they are.

        A mixture has components of all structures, of which a density needs a few. The
        weights stay those in the whole mixture.
        """
        if self.members is None:
            return self
        bare = eqx.tree_at(lambda m: m.members, self, None)
        rows = self.members[structure]
        own = jax.tree.map(lambda leaf: leaf[jnp.maximum(rows, 0)], bare)
        log_weight = jnp.where(rows >= 0, own.log_weight, -jnp.inf)
        return eqx.tree_at(lambda m: m.log_weight, own, log_weight)

    def component_log_density(
        self, target: StructureTarget, structure: IntScalar, z: Float[Array, " dim"]
    ) -> Float[Array, " component"]:
        """Log-weight plus log-density of every component of a structure.

        Returns:
            Minus infinity for the components of other structures.
        """
        nu, num_student = self.degrees_of_freedom, jnp.sum(self.is_student, axis=-1)
        offset = self.offset(target, z)
        distance = jnp.sum(_apply(self.whitening, offset) ** 2, axis=-1)
        student = self.log_normaliser - 0.5 * (nu + num_student) * jnp.log1p(
            distance / nu
        )
        prior = jnp.sum(
            jnp.where(self.from_prior, coordinate_log_prior(target, z)[None], 0.0),
            axis=-1,
        )
        return jnp.where(
            self.structure == structure, self.log_weight + student + prior, -jnp.inf
        )

    def offset(
        self, target: StructureTarget, z: Float[Array, " dim"]
    ) -> Float[Array, "component dim"]:
        """From each component's mean to a point, the shorter way round for angles."""
        difference = jax.vmap(target.wrap)(z[None] - self.mean)
        return jnp.where(self.is_student, difference, 0.0)

    def has_structure(self, structure: IntScalar) -> BoolScalar:
        """Whether any component belongs to a structure."""
        return jnp.any((self.structure == structure) & (self.log_weight > -jnp.inf))

    def structure_log_weight(
        self, target: StructureTarget
    ) -> Float[Array, " structure"]:
        """Log-weight of all components of each structure together."""
        is_member = self.structure[None] == jnp.arange(target.num_structures)[:, None]
        return logsumexp(jnp.where(is_member, self.log_weight[None], -jnp.inf), axis=-1)


def make_mixture(
    target: StructureTarget,
    structure: Int[Array, " component"],
    mean: Float[Array, "component dim"],
    scale_tril: Float[Array, "component dim dim"],
    log_weight: Float[Array, " component"],
    *,
    from_prior: Bool[Array, "component dim"] | None = None,
    degrees_of_freedom: int = 6,
    most_each: int | None = None,
) -> LaplaceMixture:
    """Complete a mixture with the factors that its density needs.

    Args:
        target: what it will propose for; says which coordinates a structure uses.
        structure: structure of each component.
        mean: centre of each component.
        scale_tril: lower Cholesky factor of each component's squared scale; entries of
            coordinates that are not in use, or from the prior, are ignored.
        log_weight: need not be normalised; minus infinity marks padding.
        from_prior: coordinates to draw from the prior; default: none.
        degrees_of_freedom: of the Student distributions. Five to eight bound the
            importance weights without wasting proposals.
        most_each: most components of a structure that are no padding, where that is
            known; densities then leave those of other structures alone.

    Returns:
        The mixture. Give every structure at least one component, or jumps cannot
        reach it.
    """
    dim = target.dim
    structure = structure.astype(jnp.int32)
    in_use = jax.vmap(target.in_use)(structure)
    from_prior = jnp.zeros_like(in_use) if from_prior is None else from_prior & in_use
    is_student = in_use & ~from_prior
    both = is_student[:, :, None] & is_student[:, None, :]
    identity = jnp.broadcast_to(jnp.eye(dim, dtype=mean.dtype), scale_tril.shape)
    scale_tril = jnp.where(both, jnp.tril(scale_tril), identity)
    whitening = solve_triangular(scale_tril, identity, lower=True)
    block_tril, block_whitening = _block_factors(target, whitening)
    num_student = jnp.sum(is_student, axis=-1)
    log_volume = jnp.sum(jnp.log(_diagonal(scale_tril)), axis=-1)
    return LaplaceMixture(
        structure=structure,
        mean=jnp.where(is_student, mean, 0.0),
        scale_tril=scale_tril,
        log_weight=log_weight - logsumexp(log_weight),
        from_prior=from_prior,
        is_student=is_student,
        whitening=whitening,
        log_normaliser=student_log_peak(degrees_of_freedom, num_student) - log_volume,
        block_tril=block_tril,
        block_whitening=block_whitening,
        members=None
        if most_each is None
        else _members(structure, log_weight, target.num_structures, most_each),
        degrees_of_freedom=degrees_of_freedom,
    )


def _members(
    structure: Int[Array, " component"],
    log_weight: Float[Array, " component"],
    num_structures: int,
    most_each: int,
) -> Int[Array, "structure member"]:
    """Components of each structure that are no padding, the rest -1."""
    name = jnp.where(log_weight > -jnp.inf, structure, num_structures)
    order = jnp.argsort(name, stable=True).astype(jnp.int32)
    name = name[order]
    each = jnp.arange(num_structures, dtype=name.dtype)
    place = jnp.searchsorted(name, each)[:, None] + jnp.arange(most_each)[None]
    row = jnp.minimum(place, len(order) - 1)
    is_own = (name[row] == each[:, None]) & (place < len(order))
    return jnp.where(is_own, order[row], -1)


def student_log_peak(
    degrees_of_freedom: Array | int, dim: Int[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Log-density at the mean of a Student distribution of unit scale."""
    nu = jnp.asarray(degrees_of_freedom, float)
    return (
        gammaln(0.5 * (nu + dim)) - gammaln(0.5 * nu) - 0.5 * dim * jnp.log(nu * jnp.pi)
    )


def prior_draw(noise: Noise, target: StructureTarget) -> Float[Array, " dim"]:
    """Every coordinate from its prior, in use or not."""
    return jnp.where(target.period > 0, target.period * noise.turn, noise.normal)


def coordinate_log_prior(
    target: StructureTarget, z: Float[Array, " dim"]
) -> Float[Array, " dim"]:
    """Log-prior of each coordinate as if it were in use."""
    normal = -0.5 * z**2 - 0.5 * jnp.log(2.0 * jnp.pi)
    uniform = -jnp.log(jnp.where(target.period > 0, target.period, 1.0))
    return jnp.where(target.period > 0, uniform, normal)


def is_in_cell(
    target: StructureTarget, offset: Float[Array, " dim"], mask: Bool[Array, " dim"]
) -> BoolScalar:
    """Whether angles lie within half a period of a component's mean."""
    is_angle = mask & (target.period > 0)
    return jnp.all(jnp.where(is_angle, jnp.abs(offset) < 0.5 * target.period, True))


@full_precision
def _block_factors(
    target: StructureTarget, whitening: Float[Array, "component dim dim"]
) -> tuple[Float[Array, "component dim dim"], Float[Array, "component dim dim"]]:
    """Cholesky factor of the precision within each slot, and its inverse.

    The precision is brought to a unit diagonal first: scales of a micrometre and of a
    metre then meet without loss in single precision.
    """
    same_slot = target.slot[:, None] == target.slot[None, :]
    length = jnp.sqrt(jnp.sum(whitening**2, axis=-2))
    unit = whitening / length[:, None, :]
    correlation = jnp.einsum("cki,ckj->cij", unit, unit)
    jitter = 10.0 * jnp.finfo(whitening.dtype).eps * jnp.eye(target.dim)
    factor = jnp.linalg.cholesky(
        jnp.where(same_slot[None], correlation, 0.0)
        + jitter.astype(whitening.dtype)[None]
    )
    identity = jnp.broadcast_to(
        jnp.eye(target.dim, dtype=whitening.dtype), factor.shape
    )
    inverse = solve_triangular(factor, identity, lower=True)
    return length[:, :, None] * factor, inverse / length[:, None, :]


@full_precision
def _apply(
    matrix: Float[Array, "component dim dim"], vector: Float[Array, "component dim"]
) -> Float[Array, "component dim"]:
    """One matrix times one vector for each component."""
    return jnp.einsum("cij,cj->ci", matrix, vector)


def _diagonal(
    matrix: Float[Array, "component dim dim"],
) -> Float[Array, "component dim"]:
    return jnp.diagonal(matrix, axis1=-2, axis2=-1)

"""Growing a mixture from fitted modes: Laplace bumps, prior blocks, better weights."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture, make_mixture


def laplace_mixture(
    target: StructureTarget,
    structure: Int[Array, " mode"],
    mode: Float[Array, "mode dim"],
    precision: Float[Array, "mode dim dim"],
    log_density: Float[Array, " mode"],
    *,
    widening: float = 1.0,
    degrees_of_freedom: int = 6,
    most_each: int | None = None,
) -> LaplaceMixture:
    r"""Put a component on each mode, weighed by its Laplace evidence.

    $$\log w = \log p(k, \hat z) + \tfrac{d}{2} \log 2 \pi - \tfrac12 \log |H|.$$

    An angle's precision is raised by that of a uniform distribution over its period,
    so that an angle which the data leave open keeps a finite width.

    Args:
        target: the density whose modes these are.
        structure: structure of each mode.
        mode: coordinates of each mode.
        precision: negative Hessian (or Gauss-Newton matrix) of the log-density there,
            prior included; rows of coordinates not in use are ignored.
        log_density: of the target at the mode; minus infinity drops the mode.
        widening: factor on the scale of every component.
        degrees_of_freedom: of the Student components.
        most_each: most modes of a structure, where that is known.

    Returns:
        The mixture. A mode with a precision that is not positive definite is dropped.
    """
    in_use = jax.vmap(target.in_use)(structure)
    both = in_use[:, :, None] & in_use[:, None, :]
    period = target.period
    floor = jnp.where(period > 0, 12.0 / jnp.where(period > 0, period, 1.0) ** 2, 0.0)
    identity = jnp.broadcast_to(jnp.eye(target.dim, dtype=mode.dtype), precision.shape)
    precision = jnp.where(both, precision + jnp.diag(floor)[None], identity)
    scale_tril, log_volume, is_positive = _inverse_factor(precision)
    num_used = jnp.sum(in_use, axis=-1)
    log_weight = log_density + 0.5 * num_used * jnp.log(2.0 * jnp.pi) + log_volume
    is_usable = is_positive & jnp.isfinite(log_weight)
    return make_mixture(
        target,
        structure,
        mode,
        widening * jnp.where(is_usable[:, None, None], scale_tril, identity),
        jnp.where(is_usable, log_weight, -jnp.inf),
        degrees_of_freedom=degrees_of_freedom,
        most_each=most_each,
    )


def add_slot_components(
    target: StructureTarget,
    mixture: LaplaceMixture,
    *,
    total_weight: float = 0.5,
    num_modes: int = 1,
) -> LaplaceMixture:
    """Add "mode of a structure with one slot less, times the prior of that slot".

    Where a constraint is hardly visible its coordinates follow the prior, along ridges
    that no Laplace component covers; these components do.

    Args:
        target: says which structures exist.
        mixture: components to start from.
        total_weight: share of each structure's weight that its new components get. A
            structure without components of its own counts as one of average weight.
        num_modes: heaviest components of each smaller structure to use.

    Returns:
        A larger mixture; combinations that do not exist are padding.
    """
    num_structures, num_slots = target.structures.shape
    is_member = mixture.structure[None] == jnp.arange(num_structures)[:, None]
    member_weight = jnp.where(is_member, mixture.log_weight[None], -jnp.inf)
    num_modes = min(num_modes, mixture.num_components)
    _, best = jax.lax.top_k(member_weight, num_modes)
    grown, exists = _grown_structures(target)
    base = jnp.repeat(best[:, None, :], num_slots, axis=1).reshape(-1)
    parent = jnp.repeat(jnp.arange(num_structures), num_slots * num_modes)
    slot = jnp.tile(jnp.repeat(jnp.arange(num_slots), num_modes), num_structures)
    structure = grown[parent, slot]
    is_valid = exists[parent, slot] & (member_weight[parent, base] > -jnp.inf)
    new = _like(mixture, base, structure, target.slot[None] == slot[:, None])
    own = mixture.structure_log_weight(target)
    has_own = own > -jnp.inf
    average = logsumexp(own) - jnp.log(jnp.maximum(jnp.sum(has_own), 1))
    num_new = jax.ops.segment_sum(
        is_valid.astype(own.dtype), structure, num_segments=num_structures
    )
    share = jnp.where(has_own & (num_new > 0), total_weight, 0.0)
    new_share = jnp.where(has_own, share, 1.0)
    whole = jnp.where(has_own, own, average)
    new_weight = whole + jnp.log(new_share) - jnp.log(jnp.maximum(num_new, 1.0))
    return _concatenate(
        target,
        _weighted(mixture, mixture.log_weight + jnp.log1p(-share)[mixture.structure]),
        _weighted(new, jnp.where(is_valid, new_weight[structure], -jnp.inf)),
        num_slots * num_modes,
    )


def add_prior_components(
    target: StructureTarget, mixture: LaplaceMixture, *, total_weight: float = 0.05
) -> LaplaceMixture:
    """Add the whole prior of every structure, so that jumps reach every structure.

    Args:
        target: says which structures exist.
        mixture: components to start from.
        total_weight: of all new components together, shared evenly by structures.
    """
    num_structures, dim = target.num_structures, target.dim
    prior = make_mixture(
        target,
        jnp.arange(num_structures, dtype=mixture.structure.dtype),
        jnp.zeros((num_structures, dim), mixture.mean.dtype),
        jnp.broadcast_to(
            jnp.eye(dim, dtype=mixture.mean.dtype), (num_structures, dim, dim)
        ),
        jnp.zeros(num_structures, mixture.mean.dtype),
        from_prior=jnp.ones((num_structures, dim), bool),
        degrees_of_freedom=mixture.degrees_of_freedom,
    )
    return _concatenate(
        target,
        _weighted(mixture, mixture.log_weight + jnp.log1p(-total_weight)),
        _weighted(prior, prior.log_weight + jnp.log(total_weight)),
        1,
    )


def add_spare_components(
    target: StructureTarget, mixture: LaplaceMixture
) -> LaplaceMixture:
    """Add padding, one component a structure, for `fit_spare_components` to fill."""
    num_structures, dim = target.num_structures, target.dim
    dtype = mixture.mean.dtype
    spare = make_mixture(
        target,
        jnp.arange(num_structures, dtype=mixture.structure.dtype),
        jnp.zeros((num_structures, dim), dtype),
        jnp.broadcast_to(jnp.eye(dim, dtype=dtype), (num_structures, dim, dim)),
        jnp.zeros(num_structures, dtype),
        degrees_of_freedom=mixture.degrees_of_freedom,
    )
    padding = jnp.full(num_structures, -jnp.inf, dtype)
    return _concatenate(target, mixture, _weighted(spare, padding), 1)


def fit_spare_components(
    target: StructureTarget,
    mixture: LaplaceMixture,
    mean: Float[Array, "structure dim"],
    scale_tril: Float[Array, "structure dim dim"],
    share: Float[Array, " structure"],
) -> LaplaceMixture:
    """Fill the padding of `add_spare_components`.

    A fit to draws covers ridges and skew that a bump on the mode leaves out.

    Args:
        target: says which structures exist.
        mixture: whose last components, one a structure, are padding.
        mean: of each new component.
        scale_tril: Cholesky factor of its squared scale.
        share: of the structure's weight that it gets; zero leaves it out.
    """
    num = target.num_structures
    structure = mixture.structure
    kept = mixture.log_weight + jnp.log1p(-share)[structure]
    whole = mixture.structure_log_weight(target)
    is_used = share > 0
    new = whole + jnp.log(jnp.where(is_used, share, 1.0))
    return make_mixture(
        target,
        structure,
        mixture.mean.at[-num:].set(mean),
        mixture.scale_tril.at[-num:].set(scale_tril),
        kept.at[-num:].set(jnp.where(is_used, new, -jnp.inf)),
        from_prior=mixture.from_prior,
        degrees_of_freedom=mixture.degrees_of_freedom,
        most_each=mixture.most_each,
    )


def refine_weights(
    target: StructureTarget,
    mixture: LaplaceMixture,
    structure: Int[Array, " draw"],
    z: Float[Array, "draw dim"],
    log_weight: Float[Array, " draw"],
    *,
    floor: float = 0.1,
) -> LaplaceMixture:
    """Set component weights to their share of weighted posterior draws.

    One step of expectation maximisation on the divergence from posterior to mixture;
    corrects Laplace evidence that is off by nats. Cappé et al. (2008), Adaptive
    importance sampling in general mixture classes, section 3.

    Args:
        target: the density that the draws are from.
        mixture: whose components are kept and whose weights are replaced.
        structure: structure of each draw.
        z: coordinates of each draw.
        log_weight: importance weights, need not be normalised.
        floor: weight that is spread evenly over structures, and within one over its
            components, whatever the draws say.
    """

    def share(k: Array, point: Array) -> Array:
        own = mixture.of_structure(k)
        each = own.component_log_density(target, k, point)
        shares = jnp.exp(each - logsumexp(each))
        if mixture.members is None:
            return shares
        # What is padding has no share, wherever it goes.
        return jnp.zeros_like(mixture.log_weight).at[mixture.members[k]].add(shares)

    weight = jnp.exp(log_weight - logsumexp(log_weight))
    shares = jax.vmap(share)(structure, z)
    mean_share = jnp.sum(
        jnp.where(weight[:, None] > 0, weight[:, None] * shares, 0.0), axis=0
    )
    is_used = mixture.log_weight > -jnp.inf
    num_each = jax.ops.segment_sum(
        is_used.astype(weight.dtype),
        mixture.structure,
        num_segments=target.num_structures,
    )
    even = 1.0 / (num_each[mixture.structure] * jnp.sum(num_each > 0))
    new_weight = (1.0 - floor) * mean_share + floor * even
    log_new = jnp.where(is_used, jnp.log(new_weight), -jnp.inf)
    return _weighted(mixture, log_new - logsumexp(log_new))


def _inverse_factor(
    precision: Float[Array, "mode dim dim"],
) -> tuple[Float[Array, "mode dim dim"], Float[Array, " mode"], Bool[Array, " mode"]]:
    """Lower factor of the inverse, its log-determinant, and whether it exists.

    With the order of coordinates reversed, the factor of the precision is upper in the
    old order, and its inverse transposed is lower: no inverse is ever formed. Rows are
    scaled to a unit diagonal first, for single precision.
    """
    diagonal = jnp.diagonal(precision, axis1=-2, axis2=-1)
    length = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    unit = precision / (length[:, :, None] * length[:, None, :])
    factor = jnp.linalg.cholesky(unit[:, ::-1, ::-1])
    identity = jnp.broadcast_to(jnp.eye(unit.shape[-1], dtype=unit.dtype), unit.shape)
    inverse = solve_triangular(factor, identity, lower=True)
    scale_tril = jnp.swapaxes(inverse, -1, -2)[:, ::-1, ::-1] / length[:, :, None]
    log_volume = jnp.sum(jnp.log(jnp.diagonal(scale_tril, axis1=-2, axis2=-1)), axis=-1)
    is_positive = jnp.all(diagonal > 0, axis=-1) & jnp.all(
        jnp.isfinite(scale_tril), axis=(-2, -1)
    )
    return scale_tril, log_volume, is_positive


def _grown_structures(
    target: StructureTarget,
) -> tuple[Int[Array, "structure slot"], Bool[Array, "structure slot"]]:
    """Index of each structure with each slot added, and whether that exists."""
    num_slots = target.structures.shape[-1]
    added = target.structures[:, None, :] | jnp.eye(num_slots, dtype=bool)[None]
    same = jnp.all(added[:, :, None, :] == target.structures[None, None], axis=-1)
    return jnp.argmax(same, axis=-1), jnp.any(same, axis=-1) & ~target.structures


def _like(
    mixture: LaplaceMixture,
    base: Int[Array, " new"],
    structure: Int[Array, " new"],
    is_added: Bool[Array, "new dim"],
) -> LaplaceMixture:
    """Copies for other structures, with the added coordinates from the prior."""
    bare = eqx.tree_at(lambda m: m.members, mixture, None, is_leaf=lambda x: x is None)
    copy = jax.tree.map(lambda leaf: leaf[base], bare)
    return eqx.tree_at(
        lambda new: (new.structure, new.from_prior),
        copy,
        (structure.astype(mixture.structure.dtype), copy.from_prior | is_added),
    )


def _weighted(
    mixture: LaplaceMixture, log_weight: Float[Array, " component"]
) -> LaplaceMixture:
    return eqx.tree_at(lambda new: new.log_weight, mixture, log_weight)


def _concatenate(
    target: StructureTarget, first: LaplaceMixture, second: LaplaceMixture, more: int
) -> LaplaceMixture:
    """Two mixtures as one, the second of at most so many components a structure."""

    def both(name: str) -> Array:
        return jnp.concatenate([getattr(first, name), getattr(second, name)])

    most = first.most_each
    return make_mixture(
        target,
        *(both(name) for name in ("structure", "mean", "scale_tril", "log_weight")),
        from_prior=both("from_prior"),
        degrees_of_freedom=first.degrees_of_freedom,
        most_each=None if most is None else most + more,
    )

"""MJX models that differ as the draws of a posterior do, to train policies on them.

Every draw is written as a document and compiled by MuJoCo; the rows of its elements are
then put, by name, into the model of the environment. So whatever a document can say of
a hypothesis reaches the policy, with the constants that MuJoCo derives from it, and the
model may hold further elements of its own.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.interop.mjcf_document import load_mujoco
from boomdp_jax.interop.mjcf_export import to_mjcf
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.same_bodies import check_same_bodies
from boomdp_jax.physics.scene_spec import SceneSpec

_WRITTEN = {
    "body": (
        ("pos", "quat", "ipos", "iquat", "mass", "inertia"),
        ("subtreemass", "invweight0"),
    ),
    "jnt": (("pos", "axis", "range", "solref"), ()),
    "dof": (("damping", "frictionloss", "solref"), ("invweight0", "M0")),
    "geom": (("pos", "friction", "solref", "solimp"), ()),
    "site": (("pos", "quat"), ()),
    "pair": (("friction", "solref", "solimp"), ()),
    "eq": (("data", "solref"), ()),
    "tendon": ((), ("length0", "lengthspring", "invweight0")),
    "actuator": (("biasprm", "forcerange", "gear"), ("acc0",)),
}
"""Fields of each sort of element: what a document says, what MuJoCo derives."""

_FIXED = {
    "body": ("sameframe",),
    "jnt": ("type", "limited"),
    "geom": ("type", "sameframe"),
    "site": ("sameframe",),
    "pair": ("dim",),
    "eq": ("type",),
    "actuator": ("trntype", "biastype", "forcelimited"),
}
"""Fields that MJX compiles into its program, so that no draw may change them."""


def randomise_mjx(
    model: Any,
    spec: SceneSpec,
    draws: Params | Posterior,
    *,
    num_draws: int | None = None,
) -> tuple[Any, Any]:
    """Make one MJX model of many hypotheses.

    Args:
        model: a `mujoco.mjx.Model`, or a `brax.System` for its pipeline `mjx`, from a
            document that `to_mjcf` wrote of a draw, to which sensors, sites, actuators
            and bodies of your own may have been added.
        spec: the scene.
        draws: hypotheses with one leading axis, or a posterior, whose draws are taken
            by weight.
        num_draws: how many to take of a posterior, at most; default: all.

    Returns:
        The model with a leading axis `draw` on the fields in which draws differ, and
        the tree of its `in_axes` for `jax.vmap`: 0 for these, None for others.

    Raises:
        ValueError: draws of several structures or of other bodies, or a model that is
            not of their document or none of MJX; also what `to_mjcf` refuses.
        ImportError: MuJoCo is not installed.
    """
    if not all(hasattr(model, name) for name in ("tree_replace", "opt")):
        raise ValueError(
            "model: expected a mujoco.mjx.Model (mujoco.mjx.put_model makes one of an "
            f"MjModel) or a brax.System, got {type(model).__name__}"
        )
    if isinstance(draws, Posterior):
        check_same_bodies(draws.spec, spec, "draws")
        thinned = draws.thin(draws.num_draws if num_draws is None else num_draws)
        draws = thinned.params
    host = jax.tree.map(np.asarray, draws)
    if host.density.ndim != 2:
        raise ValueError(
            "draws: expected hypotheses with one leading axis, got axes "
            f"{host.density.shape[:-1]}"
        )
    mujoco, time_step = load_mujoco(), float(model.opt.timestep)
    variants = []
    for i in range(len(host.density)):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], host)
        text = to_mjcf(spec, one, time_step=time_step)
        variants.append(mujoco.MjModel.from_xml_string(text))
    rows = {kind: _rows(model, variants, kind) for kind in _WRITTEN}
    axes = jax.tree.map(lambda leaf: None, model)
    changes: dict[str, jax.Array] = {}
    batched: dict[str, int] = {}
    for field in _field_names():
        theirs, ours = rows[field.split("_")[0]]
        base = np.asarray(getattr(model, field))
        values = np.repeat(base[None], len(variants), axis=0)
        if len(ours):
            values[:, theirs] = [getattr(each, field)[ours] for each in variants]
        if np.any(values != values[:1]):
            changes[field], batched[field] = jnp.asarray(values), 0
        elif np.any(values[0] != base):
            changes[field] = jnp.asarray(values[0])
    return model.tree_replace(changes), axes.tree_replace(batched)


def brax_randomisation(
    spec: SceneSpec, draws: Params | Posterior, *, num_draws: int | None = None
) -> Callable[[Any, jax.Array], tuple[Any, Any]]:
    """Brax's `randomization_fn` that gives each environment a draw.

    Args:
        spec: the scene.
        draws: hypotheses with one leading axis, or a posterior.
        num_draws: how many of a posterior there are to choose from, at most.

    Returns:
        A function of a system and of one random key for each environment. It returns
        the system with a leading axis `environment` where draws differ, and its
        `in_axes`: give it to `brax.training.agents.ppo.train`.
    """

    def randomise(system: Any, rng: jax.Array) -> tuple[Any, Any]:
        model, axes = randomise_mjx(system, spec, draws, num_draws=num_draws)
        batched = [name for name in _field_names() if getattr(axes, name) == 0]
        if not batched:
            return model, axes
        num = getattr(model, batched[0]).shape[0]
        chosen = jax.vmap(lambda key: jax.random.randint(key, (), 0, num))(rng)
        picked = {name: getattr(model, name)[chosen] for name in batched}
        return model.tree_replace(picked), axes

    return randomise


def _field_names() -> list[str]:
    return [
        f"{kind}_{name}"
        for kind, groups in _WRITTEN.items()
        for group in groups
        for name in group
    ]


def _rows(model: Any, variants: list[Any], kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Where elements of the documents are in the model, and in the documents."""
    label = "jnt" if kind == "dof" else kind
    own = [_names(each, label) for each in variants]
    for each in own[1:]:
        if each != own[0]:
            differing = sorted(each.keys() ^ own[0].keys())
            raise ValueError(
                "draws: expected one structure, as shapes do not change from draw to "
                f"draw, got some with and some without {', '.join(differing)}"
            )
    known = _names(model, label)
    missing = [name for name in own[0] if name not in known]
    if missing:
        raise ValueError(
            "model: expected one of the document that to_mjcf writes of these draws, "
            f"got none with the {label} {missing[0]!r}"
        )
    ours = np.array(list(own[0].values()), int)
    theirs = np.array([known[name] for name in own[0]], int)
    for field in (f"{kind}_{name}" for name in _FIXED.get(kind, ())):
        base = np.asarray(getattr(model, field))[theirs]
        for variant in variants:
            _check_fixed(field, base, getattr(variant, field)[ours], own[0])
    if kind == "dof":
        # Every joint of a document has one; its place is another in the model.
        theirs = np.asarray(model.jnt_dofadr)[theirs]
        ours = variants[0].jnt_dofadr[ours]
        base = np.asarray(model.dof_frictionloss)[theirs] > 0
        for variant in variants:
            is_dry = variant.dof_frictionloss[ours] > 0
            _check_fixed("dof_frictionloss above 0", base, is_dry, own[0])
    return theirs, ours


def _check_fixed(field: str, base: np.ndarray, own: np.ndarray, names: dict) -> None:
    differs = np.flatnonzero(base != own)
    if len(differs):
        name = list(names)[differs[0]]
        raise ValueError(
            f"draws: expected the {field} of {name!r} to be the model's, which MJX "
            f"compiles in, {base[differs[0]]}, got {own[differs[0]]}"
        )


def _names(model: Any, kind: str) -> dict[str, int]:
    """Number of every element that has a name."""
    found = {}
    for index, start in enumerate(np.asarray(getattr(model, f"name_{kind}adr"))):
        name = model.names[start : model.names.index(b"\0", start)].decode()
        if name:
            found[name] = index
    return found

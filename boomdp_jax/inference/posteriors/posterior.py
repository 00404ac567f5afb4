"""What is known after the data: weighted draws of Φ and noise, with names and scene."""

import dataclasses
import importlib
import os
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import FloatScalar, Key
from boomdp_jax.core.checked_input import whole_number
from boomdp_jax.core.history import History
from boomdp_jax.core.versions import library_versions
from boomdp_jax.inference.hypotheses.body_numbers import inferred_numbers
from boomdp_jax.inference.hypotheses.whole_motion import next_state, whole_scene
from boomdp_jax.inference.posteriors.contact_numbers import report_collisions
from boomdp_jax.inference.posteriors.file import (
    read_posterior_file,
    write_posterior_file,
)
from boomdp_jax.inference.posteriors.identity_record import as_record
from boomdp_jax.inference.posteriors.likeliest import ranking
from boomdp_jax.inference.posteriors.random_motion import add_impulse, add_reading_noise
from boomdp_jax.inference.posteriors.report import (
    SCHEMA,
    doubled,
    on_host,
    report_bodies,
    report_known,
    report_noise,
    report_structures,
    structure_probabilities,
)
from boomdp_jax.inference.posteriors.summary import plain
from boomdp_jax.inference.posteriors.table import format_report
from boomdp_jax.physics.arguments import checked_state, checked_wrench
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from boomdp_jax.physics.state import State


def _scalar(value: float | Array) -> FloatScalar:
    return jnp.asarray(value, float)


class Posterior(eqx.Module):
    """Weighted draws from P(Φ, σ | h), whatever method they come from.

    Draws of all chains lie one after the other. Which slots are active differs from
    draw to draw: that is the uncertainty about structure.
    """

    params: Params
    """Draws of Φ, leading axis `draw`."""
    noise_scale: Float[Array, "draw body 4"]
    """Sd of one reading: position [m], angle [rad], velocity [m/s], spin [rad/s]."""
    log_weight: Float[Array, " draw"]
    """Normalised."""
    log_density: Float[Array, " draw"]
    """Unnormalised log-posterior density, as the method reports it."""
    chain: Int[Array, " draw"]
    """Chain that a draw comes from."""
    prior_params: Params
    """Prior draws, leading axis of their own, with every inferable slot active."""
    prior_noise_scale: Float[Array, "prior_draw body 4"]
    """Prior draws of `noise_scale`."""
    inferred: dict[str, np.ndarray] = eqx.field(static=True, converter=as_record)
    """Which slots are inferred, not known, by kind: joints `[joint]`, wheel `[body,
    wheel]`, ground `[body, ground]`."""
    spec: SceneSpec = eqx.field(static=True)
    """The scene that this is about; names the axes."""
    log_evidence: FloatScalar = eqx.field(converter=_scalar, default=float("nan"))
    """Log marginal likelihood; NaN where the method gives none."""
    diagnostics: dict = eqx.field(
        static=True,
        converter=as_record,
        default_factory=lambda: {"ok": True, "reasons": []},
    )
    """`ok`, `reasons`, and the numbers behind them."""
    seconds: dict = eqx.field(static=True, converter=as_record, default_factory=dict)
    """Wall time spent on `compile` and on `run` [s]."""
    impulse_scale: Float[Array, "draw body 2"] | None = None
    """Sd of the change of velocity [m/s] and spin [rad/s] that every step starts with;
    None where the method takes the motion as exact."""
    prior_impulse_scale: Float[Array, "prior_draw body 2"] | None = None
    """Prior draws of `impulse_scale`."""
    seed: int | None = eqx.field(static=True, default=None)
    versions: dict = eqx.field(
        static=True, converter=as_record, default_factory=library_versions
    )

    __hash__ = object.__hash__

    def __eq__(self, other: object) -> bool:
        return self is other

    # Equinox's own bound methods compare every number, which fails while JAX traces.
    __getattribute__ = object.__getattribute__

    @property
    def degrees_of_freedom(self) -> float | None:
        """Of Student-t noise of scale `noise_scale`; None: it is normal."""
        return self.diagnostics.get("degrees_of_freedom")

    @property
    def num_draws(self) -> int:
        """How many draws there are."""
        return self.log_weight.shape[0]

    @property
    def weights(self) -> np.ndarray:
        """Weight of each draw; they sum to one, `[draw]`."""
        log_weight = np.asarray(self.log_weight, np.float64)
        weights = np.exp(log_weight - log_weight.max())
        return weights / weights.sum()

    def structure_probabilities(self) -> dict[str, float]:
        """Probability of each structure by its readable name, most probable first."""
        return structure_probabilities(
            self.spec, on_host(self.params), self.weights, self.inferred
        )

    def to_json(self) -> dict:
        """The posterior in numbers, a `boomdp-infer-1` object.

        Static bodies are left out. Anchors and wheel poses are in the frame of the
        outline as authored. `known_constraints` lists constraints that the scene file
        states with a number left open; `contact` is there where friction or restitution
        of contact is inferred, `mass_ratios` where bodies can collide. What is not
        finite is None.
        """
        params, prior = on_host(self.params), on_host(self.prior_params)
        weights = self.weights
        report = {
            "schema": SCHEMA,
            "bodies": report_bodies(
                self.spec,
                np.asarray(params.density),
                weights,
                np.asarray(prior.density),
                inferred_numbers(params, prior),
            ),
            "structure": report_structures(
                self.spec, params, weights, prior, self.inferred
            ),
            "known_constraints": report_known(
                self.spec, params, weights, prior, self.inferred
            ),
            **report_collisions(self.spec, params, weights, prior),
            "noise": report_noise(
                self.spec,
                np.asarray(self.noise_scale, np.float64),
                weights,
                np.asarray(self.prior_noise_scale, np.float64),
                doubled(self.impulse_scale),
                doubled(self.prior_impulse_scale),
            ),
            "log_evidence": float(self.log_evidence),
            "diagnostics": {"ok": True, "reasons": [], **self.diagnostics},
            "seconds": {"compile": None, "run": None, **self.seconds},
            "seed": self.seed,
            "versions": dict(self.versions),
        }
        return plain(report)

    def summary(self) -> str:
        """A table for people: bodies, structures, constraints, noise, diagnostics."""
        return format_report(
            self.to_json(), self.structure_probabilities(), self.num_draws
        )

    def ranking(self) -> Float[Array, " draw"]:
        """Largest for the draw to take if it has to be one; see `likeliest.ranking`."""
        weights = jax.nn.softmax(self.log_weight)
        return ranking(self.params, self.inferred, weights, self.log_density)

    def sample_indices(self, key: Key, num_samples: int) -> Int[Array, " sample"]:
        """Draw places in the list of draws, by weight and independently.

        Raises:
            ValueError: a number of samples that is no whole number or negative.
        """
        num_samples = whole_number("num_samples", num_samples, 0)
        return jax.random.categorical(key, self.log_weight, shape=(num_samples,))

    def sample_params(self, key: Key, num_samples: int) -> Params:
        """Draw hypotheses by weight and independently, leading axis `num_samples`.

        Under `jax.jit` the number of samples is static.

        Raises:
            ValueError: a number of samples that is no whole number or negative.
        """
        chosen = self.sample_indices(key, num_samples)
        return jax.tree.map(lambda leaf: leaf[chosen], self.params)

    def thin(self, num_draws: int) -> "Posterior":
        """Keep at most so many draws, stratified by cumulative weight.

        The draws that are kept have equal weights; with fewer effective draws than
        asked for, some occur more than once.

        Raises:
            ValueError: a number of draws that is no whole number or under one.
        """
        num_draws = whole_number("num_draws", num_draws, 1)
        weights = self.weights
        num_draws = min(num_draws, self.num_draws)
        if num_draws == self.num_draws and np.ptp(weights) < 1e-6 / num_draws:
            return self
        cumulative = np.cumsum(weights)
        # One draw at random, always the same, from each of so many equal shares: even
        # spacing would resonate with a chain that has a period.
        inside = np.random.default_rng(0).uniform(size=num_draws)
        levels = (np.arange(num_draws) + inside) / num_draws
        chosen = np.minimum(np.searchsorted(cumulative, levels), self.num_draws - 1)
        kept = jax.tree.map(
            lambda leaf: leaf[chosen],
            (
                self.params,
                self.noise_scale,
                self.impulse_scale,
                self.log_density,
                self.chain,
            ),
        )
        equal = jnp.full(num_draws, -np.log(num_draws), self.log_weight.dtype)
        return eqx.tree_at(
            lambda p: (
                p.params,
                p.noise_scale,
                p.impulse_scale,
                p.log_density,
                p.chain,
                p.log_weight,
            ),
            self,
            (*kept, equal),
            is_leaf=lambda leaf: leaf is None,
        )

    def transition(
        self, key: Key, state: State, wrench: Float[Array, "body 3"]
    ) -> State:
        """Draw the next reading: the paper's generative process, one call.

        Φ, σ ~ P(·|h); the state is stepped under Φ, after an impulse where the motion
        has noise of its own; noise of scale σ is added. Every call draws a hypothesis;
        a planner that keeps one takes it from `sample_params`. Where commands have a
        delay, the wrench is that in effect (`delayed_wrenches`).

        Args:
            key: random key.
            state: where the bodies are.
            wrench: held over the scene's time step [N, N, N m].

        Returns:
            A reading of the next state.

        Raises:
            ValueError: no state, or one or a wrench of another shape.
        """
        state = checked_state(self.spec.num_bodies, state)
        wrench = checked_wrench(self.spec.num_bodies, wrench)
        draw_key, noise_key, kick_key = jax.random.split(key, 3)
        chosen = self.sample_indices(draw_key, 1)[0]
        params, noise_scale, impulse_scale = jax.tree.map(
            lambda leaf: leaf[chosen],
            (self.params, self.noise_scale, self.impulse_scale),
        )
        with jax.ensure_compile_time_eval():
            world = whole_scene(self.spec)
        params, is_static = self.spec.with_surface(params), world.scene.is_static
        state = add_impulse(kick_key, state, impulse_scale, is_static)
        after = next_state(world, params, state, wrench)
        law = (noise_scale, is_static, self.degrees_of_freedom)
        return add_reading_noise(noise_key, after, *law)

    def predict(
        self,
        history: History,
        horizons: int | Iterable[int] = (1, 10, 50),
        **options: Any,
    ) -> dict:
        """Score predictions of held-out motion; see `inference.predict`."""
        from boomdp_jax.inference.posteriors.predict import predict

        return predict(self, history, horizons, **options)

    def plot(
        self, path: str | os.PathLike | None = None, history: History | None = None
    ) -> Any:
        """Draw the posterior on one figure, and write it where a path is given.

        Args:
            path: picture file to write; its ending says the format.
            history: held-out motion to set predictions against.

        Returns:
            A `matplotlib.figure.Figure`.
        """
        # Pictures lie layers above, on which nothing here depends.
        viz = importlib.import_module("boomdp_jax.viz")
        return viz.plot_posterior(self, path, history=history)

    def to_arviz(self) -> object:
        """ArviZ's container, with dimensions named by body, joint and wheel."""
        return importlib.import_module("boomdp_jax.interop.arviz").to_arviz(self)

    def save(self, path: str | os.PathLike) -> None:
        """Write an NPZ file with a JSON header that `load_posterior` reads."""
        slots = self.inferred.items()
        arrays = {f"inferred.{kind}": np.asarray(each, bool) for kind, each in slots}
        for name in _ARRAYS + _OPTIONAL:
            if getattr(self, name) is not None:
                arrays[name] = np.asarray(getattr(self, name))
        header = {
            "scene": self.spec.to_dict(),
            "diagnostics": plain(dict(self.diagnostics)),
            "seconds": plain(dict(self.seconds)),
            "seed": self.seed,
            "versions": dict(self.versions),
        }
        write_posterior_file(path, arrays, self.params, self.prior_params, header)


def with_diagnostics(
    posterior: Posterior, reasons: Iterable[str], extras: dict | None = None
) -> Posterior:
    """Add reasons for doubt, and further entries, to the diagnostics.

    Args:
        posterior: draws.
        reasons: with any, the diagnostics are not ok.
        extras: further entries.
    """
    diagnostics = dict(posterior.diagnostics)
    diagnostics["reasons"] = [*diagnostics["reasons"], *reasons]
    diagnostics["ok"] = not diagnostics["reasons"]
    diagnostics |= extras or {}
    return dataclasses.replace(posterior, diagnostics=diagnostics)


_ARRAYS = (
    "noise_scale",
    "log_weight",
    "log_density",
    "chain",
    "prior_noise_scale",
    "log_evidence",
)
_OPTIONAL = ("impulse_scale", "prior_impulse_scale")


def load_posterior(path: str | os.PathLike) -> Posterior:
    """Read what `Posterior.save` wrote.

    Args:
        path: the file.

    Returns:
        The posterior, the same to the bit on the float type that it was saved on.

    Raises:
        ValueError: not such a file, a damaged one, another schema, or shapes that do
            not fit together; one line.
        OSError: the file cannot be opened.
    """
    arrays, params, prior_params, header = read_posterior_file(path)
    spec = scene_spec_from_dict(header["scene"], source=f"{path}: scene")
    num_bodies = params.density.shape[1]
    if num_bodies != len(spec.bodies):
        raise ValueError(
            f"{path}: expected draws of {len(spec.bodies)} bodies as in the scene, got "
            f"{num_bodies}"
        )
    fields: dict[str, Any] = {
        name: jnp.asarray(arrays[name])
        for name in _ARRAYS + _OPTIONAL
        if name in arrays
    }
    for name in ("diagnostics", "seconds", "seed", "versions"):
        fields[name] = header[name]
    fields["inferred"] = {
        name.removeprefix("inferred."): array
        for name, array in arrays.items()
        if name.startswith("inferred.")
    }
    return Posterior(params=params, prior_params=prior_params, spec=spec, **fields)

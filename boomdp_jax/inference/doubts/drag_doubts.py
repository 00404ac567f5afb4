"""Pinned bodies whose friction may as well be that of a wheel or of the floor."""

import itertools
from typing import NamedTuple

import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.inference.hypotheses.prior import read_prior
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.physics.params import WORLD, Params
from boomdp_jax.physics.scene_spec import SceneSpec

# Probability of a pin from which it is asked, and by how much that of a wheel or a
# floor may differ from what the drag alone says.
_LEAST, _MOST_GAP = 0.5, 0.15
_KINDS = ("wheel", "ground")
# Drags are compared at the fastest turn (but for outliers) and at this share of it.
_QUANTILE, _SLOW = 0.95, 0.25
# How often each prior draw of a wheel is taken, with another pin's friction; and the
# kernel that drags are smoothed with, in logarithms, no narrower.
_TIMES, _WIDTH = 50, 0.05


def drag_reasons(spec: SceneSpec, history: History, posterior: Posterior) -> list[str]:
    r"""Reasons for doubt about what brakes bodies that are pinned to the world.

    About a pin a wheel is drag, and so are friction with the floor and friction of the
    pin: little but the priors tells them apart. How probable each set S of wheel and
    floor then is follows from the drag d alone, $\pi(S) p(d \mid S)$, d being drawn
    from the prior. Samplers seldom find as much: what has the same drag is a thin and
    curved sheet in the many numbers of a wheel, a floor and a pin, which neither bumps
    nor walks get round. Of a wheel that is asked where there is no friction with the
    floor: beside it a weak one hardly shows.

    Args:
        spec: the scene.
        history: its readings.
        posterior: what was inferred.

    Returns:
        One line for each such body where that differs from the posterior; of kinds of
        which a body may have more than one, none.
    """
    params = posterior.params
    asked = [kind for kind in _KINDS if spec.unknown.get(kind, 0) == 1]
    has_pins = params.revolute.active.shape[-1] > 0
    if not asked or not has_pins or spec.normal_gravity == 0.0:
        return []
    to_world = np.asarray(params.revolute.body_b) == WORLD
    reasons = []
    for body, name in enumerate(spec.names):
        holds = np.asarray(params.revolute.active) & to_world
        holds &= np.asarray(params.revolute.body_a) == body
        rows = np.flatnonzero(holds.any(axis=-1))
        weight = np.asarray(posterior.weights, float)[rows]
        is_known = any(c.kind in _KINDS and c.body_a == body for c in spec.constraints)
        spin = _fastest_turn(history, body)
        if is_known or not spin or spec.is_center_unknown[body]:
            continue
        if weight.sum() < _LEAST:
            continue
        weight = weight / weight.sum()
        pin = np.argmax(holds[rows], axis=-1)
        anchor = np.asarray(params.revolute.anchor_a, float)[rows, pin]
        spins = spin * np.array([_SLOW, 1.0])
        about = _About(spec, params, body, rows, anchor, spins)
        mass = _by_drag(about, posterior.prior_params, weight, pin, asked)
        has = {
            kind: np.asarray(getattr(params, kind).active)[rows, body].any(axis=-1)
            for kind in asked
        }
        without = weight if "ground" not in has else weight * ~has["ground"]
        told = []
        if "wheel" in has and without.sum() >= _LEAST:
            both = mass[frozenset()] + mass[frozenset({"wheel"})]
            by_drag = mass[frozenset({"wheel"})] / max(both, 1e-300)
            by_draws = without @ has["wheel"] / without.sum()
            told.append(("a wheel", by_drag, by_draws))
        if "ground" in has:
            floor = sum(value for kinds, value in mass.items() if "ground" in kinds)
            by_drag = floor / max(sum(mass.values()), 1e-300)
            told.append(("friction with the floor", by_drag, weight @ has["ground"]))
        for kind, by_drag, by_draws in told:
            if abs(by_drag - by_draws) > _MOST_GAP:
                reasons.append(
                    f"{name}: about its pin {kind} is drag, as friction of the pin is: "
                    f"by how much there is of it the probability is {by_drag:.2f}, by "
                    f"the draws {by_draws:.2f}; neither is to be relied on"
                )
    return reasons


def _by_drag(
    about: "_About",
    prior: Params,
    weight: np.ndarray,
    pin: np.ndarray,
    asked: list[str],
) -> dict[frozenset[str], float]:
    """How probable each set of some kinds is on a body on a pin, but for a constant.

    Args:
        about: draws with the pin.
        prior: draws of the prior, with every slot active.
        weight: of each draw, summing to one.
        pin: which pin each has.
        asked: the kinds.
    """
    spec, body, spins = about.spec, about.body, about.spins
    own = _pin_drag(_PinFriction.of(about, pin), spins)
    seen = np.log(own + about.wheels() + about.floor())
    middle = weight @ seen
    width = np.hypot(np.sqrt(weight @ (seen - middle) ** 2), _WIDTH)
    every = np.arange(len(prior.density))
    anchor = np.broadcast_to(weight @ about.anchor, (len(every), 2))
    drawn = _About(spec, prior, body, every, anchor, spins)
    friction = _PinFriction.of(drawn, np.full(len(every), pin[0]))
    own = _pin_drag(friction.drawn_again(np.random.default_rng(0), _TIMES), spins)
    each = {"wheel": drawn.wheels(), "ground": drawn.floor()}
    share = read_prior(spec.prior, spec.source).probability
    mass = {}
    for chosen in itertools.product((False, True), repeat=len(asked)):
        drag, weight_of_set = own, 1.0
        for kind, has in zip(asked, chosen, strict=True):
            weight_of_set *= share[kind] if has else 1.0 - share[kind]
            if has:
                drag = drag + np.tile(each[kind], (_TIMES, 1))
        kinds = frozenset(itertools.compress(asked, chosen))
        mass[kinds] = weight_of_set * _density(drag, middle, width)
    return mass


def _density(drag: np.ndarray, middle: np.ndarray, width: np.ndarray) -> float:
    """Of a drag, but for a constant, from draws of it `[draw, spin]`."""
    distance = (np.log(drag) - middle) / width
    return float(np.mean(np.exp(-0.5 * np.sum(distance**2, axis=-1))))


def _fastest_turn(history: History, body: int) -> float | None:
    """About the greatest spin that a body was read with; None: it was not read."""
    state = np.where(history.state_mask, history.state, np.nan)
    state = state[np.asarray(history.mask), body]
    spin = state[:, 5]
    if np.isnan(spin).all():
        dt = np.asarray(history.dt)[np.asarray(history.mask)]
        is_next = np.asarray(history.is_chained)[np.asarray(history.mask)][1:]
        spin = np.where(is_next, np.diff(state[:, 2]) / dt[:-1], np.nan)
    spin = np.abs(spin[np.isfinite(spin)])
    return float(np.quantile(spin, _QUANTILE)) if spin.size else None


class _PinFriction(NamedTuple):
    """Of many draws."""

    rate: np.ndarray
    """Viscous, over the inertia about the pin [1/s]."""
    limit: np.ndarray
    """Dry, over that inertia [1/s²]."""

    @classmethod
    def of(cls, about: "_About", pin: np.ndarray) -> "_PinFriction":
        """That of one pin of each draw, which another place may be asked about."""
        pins, rows = about.params.revolute, about.rows
        anchor = np.asarray(pins.anchor_a, float)[rows, pin]
        inertia = about._replace(anchor=anchor).inertia()
        viscous, dry = (
            np.asarray(leaf, float)[rows, pin] for leaf in (pins.viscous, pins.dry)
        )
        return cls(viscous / inertia, dry / inertia)

    def drawn_again(self, rng: np.random.Generator, times: int) -> "_PinFriction":
        """So many times as many, as both priors are log-normal: their tails count."""
        return _PinFriction(*(_like(rng, part, times * len(part)) for part in self))


def _like(rng: np.random.Generator, values: np.ndarray, num: int) -> np.ndarray:
    """Numbers of the log-normal distribution that positive ones are of."""
    if not np.isfinite(values).all():
        return np.full(num, np.inf)
    logarithm = np.log(np.maximum(values, 1e-300))
    return np.exp(rng.normal(logarithm.mean(), logarithm.std(), num))


def _pin_drag(friction: _PinFriction, spins: np.ndarray) -> np.ndarray:
    """Rates at which spins slow down, over the spins, `[draw, spin]` [1/s]."""
    rate, limit = friction.rate[:, None], friction.limit[:, None]
    return np.maximum(np.minimum(rate, limit / spins), 1e-12)


class _About(NamedTuple):
    """Many draws of a body on a pin, and what slows it down."""

    spec: SceneSpec
    params: Params
    body: int
    rows: np.ndarray
    """Which draws."""
    anchor: np.ndarray
    """Of the pin of each, about the centre of mass [m]."""
    spins: np.ndarray
    """At which."""

    def inertia(self) -> np.ndarray:
        """About the pin, `[draw]` [kg m²]."""
        gyration = float(self.spec.scene.gyration[self.body])
        return self.mass() * (gyration + np.sum(self.anchor**2, axis=-1))

    def mass(self) -> np.ndarray:
        """`[draw]` [kg]."""
        density = np.asarray(self.params.density, float)[self.rows, self.body]
        return density * self.spec.bodies[self.body].area

    def wheels(self) -> np.ndarray:
        """Rates as `_pin_drag` has them, of wheels, limits included."""
        wheel, rows, body = self.params.wheel, self.rows, self.body
        offset = np.asarray(wheel.position, float)[rows, body] - self.anchor[:, None]
        x, y = np.moveaxis(offset, -1, 0)
        heading = np.asarray(wheel.heading, float)[rows, body]
        # How fast it rolls and slides at unit spin.
        along = -y * np.cos(heading) + x * np.sin(heading)
        across = y * np.sin(heading) + x * np.cos(heading)
        track = 0.0
        if wheel.half_track is not None:
            track = np.asarray(wheel.half_track, float)[rows, body]
        speeds = np.stack([np.hypot(along, track), np.abs(across)], axis=-1)
        viscous, dry = (
            np.asarray(leaf, float)[rows, body] for leaf in (wheel.viscous, wheel.dry)
        )
        drag = np.sum(viscous * speeds**2, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(viscous > 0.0, viscous * speeds / dry, 0.0)
        slip = np.sqrt(np.sum(share**2, axis=-1))[..., None] * self.spins
        return self._added(drag[..., None] / np.maximum(slip, 1.0), wheel.active)

    def floor(self) -> np.ndarray:
        """The same of feet (without a torque that does not depend on sliding)."""
        ground, rows, body = self.params.ground, self.rows, self.body
        spec = self.spec.bodies[body]
        dry, viscous = (
            np.asarray(leaf, float)[rows, body] for leaf in (ground.dry, ground.viscous)
        )
        scale = np.ones((*dry.shape, 2))
        if ground.stance_scale is not None:
            scale = np.asarray(ground.stance_scale, float)[rows, body]
        foot = spec.feet * scale[..., None, :] - self.anchor[:, None, None]
        square = np.sum(foot**2, axis=-1) + spec.foot_size**2
        load = np.broadcast_to(spec.foot_load, square.shape)
        if ground.corner_share is not None:
            corner = np.asarray(ground.corner_share, float)[rows, body][..., None]
            load = load + corner * (spec.corner_load - load)
        limit = dry * (self.mass() * self.spec.normal_gravity)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            knee = np.where(viscous > 0.0, limit / viscous, np.inf)[..., None, None]
            speed = np.sqrt(square)[..., None] * self.spins
            kept = np.minimum(1.0, knee / np.maximum(speed, 1e-12))
        each = viscous[..., None, None] * (load * square)[..., None] * kept
        return self._added(each.sum(axis=-2), ground.active)

    def _added(self, each: np.ndarray, active) -> np.ndarray:
        """Torques of all slots that exist, over the inertia, `[draw, spin]`."""
        exists = np.asarray(active)[self.rows, self.body][..., None]
        return np.where(exists, each, 0.0).sum(axis=1) / self.inertia()[:, None]

r"""A belief that takes one transition at a time: particles over structures and numbers.

`step` is one compiled function over a table of fixed capacity (`online.step`): every
particle's filter takes the new readings in, weights change, and where few particles are
left in effect they are resampled and moved. It never recompiles and needs no more time
the longer the history is. `refit` fits the scene anew (`online.refit`), mostly from
where the last fit was, which takes some tenths of a second for one body; now and then
everywhere, which takes one or two seconds. `observe` is a step, and a refit when the
belief asks for one.

Prefer `infer` where all data are there; this where they come one by one and something
has to be decided in between. Chopin (2002), A sequential particle filter method for
static models; Gilks and Berzuini (2001), Following a moving target.
"""

import functools
import os
import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import BoolScalar, Key, on_device
from boomdp_jax.core.checked_input import positive_seconds, whole_number
from boomdp_jax.core.compile_ahead import signature
from boomdp_jax.core.history import History
from boomdp_jax.inference.arguments import check_history, check_key
from boomdp_jax.inference.doubts.all_doubts import with_doubts
from boomdp_jax.inference.online.check import check_online
from boomdp_jax.inference.online.file import (
    read_belief,
    settings_for_file,
    write_belief,
)
from boomdp_jax.inference.online.fit import make_online_block, refit_settings
from boomdp_jax.inference.online.groups import BlockGroups
from boomdp_jax.inference.online.posterior import (
    best_params,
    online_params,
    online_posterior,
    structure_share,
)
from boomdp_jax.inference.online.refit import RefitInfo, prior_belief, refit_block
from boomdp_jax.inference.online.refresh import (
    LEAVING_SHARE,
    OnlineInfo,
    compiled_refresh,
)
from boomdp_jax.inference.online.rows import empty_table, step_length, table_of
from boomdp_jax.inference.online.state import BeliefState, BlockBelief
from boomdp_jax.inference.online.warm_up import try_out
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.readings.components import independent_blocks
from boomdp_jax.physics.arguments import checked_state, checked_wrench
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.state import State

# First refit, in transitions; then whenever this share of those fitted has come anew.
# Gains are those of the last fit: when the table had nearly doubled since, quantiles of
# a pinned box's mass were a standard deviation off those of a fit of all rows.
_FIRST_REFIT, _GROWN = 8, 0.5
# A refit for lack of particles in effect comes no sooner than so many transitions after
# the last, and after this share of the table has been renewed.
_REST, _RENEWED = 4, 0.25


class Observed(NamedTuple):
    """What became of one transition."""

    step: OnlineInfo
    refit: RefitInfo | None


class OnlineBelief:
    r"""Settings and compiled functions of an online belief about one scene.

    Bodies that are or may be tied form a block; blocks are independent and each has its
    particles. Which pairs may be tied follows from the scene alone, so that a tie can
    turn up late, unless `screen` says which pairs have been seen to move apart.

    With `forgetting` $\lambda < 1$ what a row n rows old told, given all before it,
    counts $\lambda^n$ times, so that the prior comes back where nothing new is learnt.
    The state is not forgotten: older pushes tell through today's velocity, and sds are
    below those of `infer` on the last $1 / (1 - \lambda)$ rows: 1.5 to 3 times, of a
    box's mass at 0.95. Changes within twice that are not allowed for, or found late.
    """

    def __init__(
        self,
        spec: SceneSpec,
        *,
        capacity: int = 256,
        num_particles: int = 1024,
        forgetting: float = 1.0,
        dt: float | None = None,
        has_varying_dt: bool = False,
        change_rate: float = 1.0 / 256.0,
        num_noise_levels: int = 8,
        screen: History | None = None,
    ):
        """Set up.

        Args:
            spec: the scene: outlines, what is known, what may exist.
            capacity: transitions that are remembered. When the table is full the oldest
                eighth of it leaves at once, and with it what it told.
            num_particles: of each block, a multiple of 16.
            forgetting: factor per transition on the weight of all before, in (0, 1].
            dt: length of every step [s]; default: the scene's.
            has_varying_dt: whether `step` is told each step's length instead, which
                costs a little more.
            change_rate: prior probability per transition that the world changes, for
                the test that a surprise leads to; with zero it never does, and a
                surprise leads to a fit of all rows from anywhere.
            num_noise_levels: of each structure of a lone body, over which its noise is
                averaged. With one, noise is taken for what the last refit found: steps
                and refits take two thirds of the time, and the belief comes out too
                narrow where much depends on the noise.
            screen: readings of all bodies; pairs that they show to move apart are
                never tied (see `independent_blocks`).

        Raises:
            TypeError: a scene or a screen that is none.
            ValueError: a number out of range; a scene that `infer` refuses.
        """
        self._settings = refit_settings(
            spec,
            num_particles=num_particles,
            is_uniform=not has_varying_dt,
            forgetting=forgetting,
            change_rate=change_rate,
            num_levels=num_noise_levels,
        )
        self.capacity = whole_number("capacity", capacity, LEAVING_SHARE)
        self.spec = spec
        self._dt = positive_seconds("dt", spec.dt if dt is None else dt)
        self._empty = empty_table(spec.num_bodies, self.capacity, self._dt)
        seen = self._empty if screen is None else screen
        check_history(spec, seen, "screen")
        self._groups = BlockGroups.of(
            [
                make_online_block(self._settings, bodies, self._empty)
                for bodies in independent_blocks(spec, seen, is_complete=False)[0]
            ]
        )
        self._step = compiled_refresh(self._groups.bodies, float(forgetting))

    @property
    def blocks(self) -> list[tuple[str, ...]]:
        """Names of the bodies of each block, in the order in which infos list them."""
        return [
            tuple(self.spec.names[body] for body in bodies)
            for group in self._groups.bodies
            for bodies in group
        ]

    def init(self, key: Key, history: History | None = None) -> BeliefState:
        """Begin with the prior, or with what a history says.

        Args:
            key: random key; all that follows is decided by it and the transitions.
            history: transitions to begin with, which are fitted at once (seconds).

        Returns:
            The belief, a pytree of arrays.

        Raises:
            ValueError: a history of another number of bodies, of more transitions than
                the capacity, or of steps of another length.
        """
        check_key(key)
        table, num_rows = self._empty, 0
        if history is not None:
            check_history(self.spec, history)
            dt = self._dt if self._settings.is_uniform else None
            table = table_of(self._empty, history, dt)
            num_rows = int(table.num_transitions)
        key, prior_key = jax.random.split(key)
        beliefs = {
            index: prior_belief(
                jax.random.fold_in(prior_key, index), self._settings, block
            )
            for index, block in enumerate(self._groups.blocks)
        }
        integer = jnp.zeros((), int).dtype
        state = BeliefState(
            key=key,
            history=table,
            num_rows=on_device(num_rows, integer),
            num_seen=on_device(num_rows, integer),
            refit_at=on_device(_FIRST_REFIT, integer),
            refit_after=on_device(_REST, integer),
            blocks=self._groups.stacked(beliefs),
        )
        return self.refit(state)[0] if num_rows else state

    def step(
        self,
        belief: BeliefState,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        dt: Float[Array, ""] | float | None = None,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> tuple[BeliefState, OnlineInfo]:
        """Take one transition in: a pure function that compiles once.

        It can be called under `jit` and scanned. The end of the last transition and the
        start of this one are one reading where they are equal to the bit, otherwise two
        readings of the same instant.

        Args:
            belief: so far.
            state: reading before the step; what is not finite is missing.
            wrench: at the centres of mass, held over the step [N, N, N m]. If it is not
                finite, or the length turns out not to be positive and finite under
                `jit`, the transition tells nothing; info says so.
            next_state: reading after the step, likewise.
            dt: length of the step [s], if lengths vary.
            starts_episode: whether bodies were moved otherwise since the last
                transition.

        Returns:
            The belief, and what happened.

        Raises:
            ValueError: a step length where all are equal, or none where they vary, or
                one that is not positive; states or a wrench of another shape.
        """
        length = step_length(dt, self._dt, is_uniform=self._settings.is_uniform)
        num = self.spec.num_bodies
        # Of a given type, since for a weak one the same would be compiled again.
        before, after = (
            jnp.asarray(checked_state(num, part, name).array, float)
            for name, part in (("state", state), ("next_state", next_state))
        )
        push = jnp.asarray(checked_wrench(num, wrench), float)
        begins = jnp.asarray(starts_episode, bool)
        return self._step(belief, before, push, after, length, begins)

    def observe(
        self,
        belief: BeliefState,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        dt: Float[Array, ""] | float | None = None,
        *,
        starts_episode: bool = False,
    ) -> tuple[BeliefState, Observed]:
        """A step, and a refit where the step asks for one; arguments as for `step`."""
        belief, info = self.step(
            belief, state, wrench, next_state, dt, starts_episode=starts_episode
        )
        if not bool(info.needs_refit):
            return belief, Observed(info, None)
        belief, refit = self.refit(belief)
        return belief, Observed(info, refit)

    def refit(self, belief: BeliefState) -> tuple[BeliefState, RefitInfo]:
        """Fit every block anew to the table; not for `jit`.

        Where a block's readings have looked odd since some row, and its world is found
        to have changed then, its rows before that are left out from now on.

        Args:
            belief: so far.

        Returns:
            The belief with fresh particles, mixtures and gains; what was found.
        """
        start = time.perf_counter()
        key, refit_key = jax.random.split(belief.key)
        num_rows = int(belief.num_rows)
        beliefs: dict[int, BlockBelief] = {}
        found = []
        parts = zip(self._groups.order, self._groups.parts(belief.blocks), strict=True)
        for index, (block, before) in parts:
            beliefs[index], info = refit_block(
                jax.random.fold_in(refit_key, index),
                self._settings,
                before,
                block.bodies,
                belief.history,
                num_rows,
            )
            found.append(info)
        latest = max((int(b.begin) for b in beliefs.values()), default=0)
        integer, used = belief.num_seen.dtype, num_rows - latest
        num_seen = int(belief.num_seen)
        wait = max(_FIRST_REFIT, int(_GROWN * used))
        rest = max(_REST, int(_RENEWED * used))
        belief = eqx.tree_at(
            lambda s: (s.key, s.blocks, s.refit_at, s.refit_after),
            belief,
            (
                key,
                self._groups.stacked(beliefs),
                on_device(num_seen + wait, integer),
                on_device(num_seen + rest, integer),
            ),
        )
        return belief, RefitInfo(tuple(found), time.perf_counter() - start)

    def warm_up(self, num_rows: int | None = None) -> None:
        """Compile what steps, refits and draws need; a minute or two, once a process.

        For who cannot wait for it when the first transition comes. It may be called on
        a thread of its own; nothing that follows depends on it but its time.

        Args:
            num_rows: of tables up to which refits are compiled; default: the capacity.

        Raises:
            ValueError: a number of rows under one.
        """
        most = self.capacity if num_rows is None else num_rows
        most = whole_number("num_rows", most, 1)
        targets = [block.target for block in self._groups.blocks]
        sizes = self.capacity, self._settings.num_particles, self._settings.num_levels
        name = signature(targets), self._step, sizes
        try_out(self, name, None if self._settings.is_uniform else self._dt, most)

    def posterior(self, belief: BeliefState, *, check: bool = True) -> Posterior:
        """Weighted draws: particles of one block, those of several paired at random.

        Args:
            belief: so far.
            check: whether to look for laws that the model lacks, and for what else
                gives `infer` to think, so that `diagnostics["ok"]` means the same. It
                takes a refit's time.
        """
        key = jax.random.fold_in(belief.key, 1)
        parts, laws = self._groups.parts(belief.blocks), None
        if check:
            known = self._settings, belief.history, int(belief.num_rows)
            laws = functools.partial(check_online, *known)
        posterior = online_posterior(key, self.spec, parts, laws)
        if not check:
            return posterior
        return with_doubts(posterior, self.spec, belief.history, [])

    def sample_params(self, key: Key, belief: BeliefState, num_samples: int) -> Params:
        """Draw hypotheses, for a planner between two steps; on the host.

        Args:
            key: random key.
            belief: so far.
            num_samples: how many, at least one.

        Returns:
            Φ, of equal weight, drawn systematically; leading axis `num_samples`.

        Raises:
            ValueError: a number of samples that is no whole number or under one.
        """
        num_samples = whole_number("num_samples", num_samples, 1)
        parts = self._groups.parts(belief.blocks)
        return online_params(key, self.spec, parts, num_samples)

    def best_params(self, belief: BeliefState) -> Params:
        """The most probable structure's most probable numbers; on the host."""
        return best_params(self.spec, self._groups.parts(belief.blocks))

    def structure_share(self, belief: BeliefState) -> float:
        """Probability of the most probable structure, the least over blocks."""
        return structure_share(self._groups.parts(belief.blocks))

    def save(self, belief: BeliefState, path: str | os.PathLike) -> None:
        """Write a belief to an NPZ file, whole or not at all; `load` reads it."""
        write_belief(path, self._for_file(), belief)

    def load(self, path: str | os.PathLike) -> BeliefState:
        """Read a belief that `save` wrote, here or in another process.

        Args:
            path: the file.

        Returns:
            The belief; what follows is the same to the bit as if it had gone on.

        Raises:
            ValueError: not such a file, a damaged one, or one of an `OnlineBelief` of
                another scene or with other settings, the first of which is named.
            OSError: the file cannot be opened.
        """

        def begin(kind: str) -> BeliefState:
            return self.init(jax.random.key(0, impl=kind))

        return read_belief(path, self._for_file(), begin)

    def _for_file(self) -> dict:
        sizes = self.capacity, self._dt, self.blocks
        return settings_for_file(self._settings, *sizes)

"""From scenes and histories to posteriors: the one call that most users need."""

import dataclasses
import functools
import time
from collections.abc import Sequence

import jax
import numpy as np
from jax.sharding import Mesh

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.checked_input import whole_number
from boomdp_jax.core.compile_time import CompileClock
from boomdp_jax.core.history import History
from boomdp_jax.core.spread import spread_over
from boomdp_jax.inference.arguments import check_arguments
from boomdp_jax.inference.assemble import assemble_posterior
from boomdp_jax.inference.batch_blocks import blocks_of_batch
from boomdp_jax.inference.between_stops import again_between_stops
from boomdp_jax.inference.blocks.block import stack_blocks
from boomdp_jax.inference.blocks.fixed_structure import Structure, check_structure
from boomdp_jax.inference.doubts.all_doubts import with_doubts, with_notes
from boomdp_jax.inference.doubts.evidence_report import BlockResult
from boomdp_jax.inference.doubts.residual import check_residuals
from boomdp_jax.inference.likelihoods.choice import (
    ChosenLikelihood,
    choose_likelihood,
    outlier_remedy,
)
from boomdp_jax.inference.likelihoods.robust_update import DEGREES_OF_FREEDOM
from boomdp_jax.inference.members import Refusals
from boomdp_jax.inference.posteriors.posterior import Posterior, with_diagnostics
from boomdp_jax.inference.progress_bar import ProgressBar
from boomdp_jax.inference.readings.outliers import outlier_notes
from boomdp_jax.inference.sample import sample_blocks
from boomdp_jax.inference.samplers.structure_draws import SampleSettings
from boomdp_jax.inference.under_numpyro.nuts import run_nuts
from boomdp_jax.inference.under_numpyro.one_structure import check_numbers
from boomdp_jax.inference.under_numpyro.svi import run_svi
from boomdp_jax.physics.scene_spec import SceneSpec

METHODS = ("auto", "rj", "enumerate", "smc", "nuts", "svi", "laplace", "map")
"""Ways to infer: `auto` is `rj`."""

OUTLIERS = {"none": None, "student-t": DEGREES_OF_FREEDOM}
"""Degrees of freedom of the noise of readings; None: it is normal."""


def infer(
    key: Key,
    spec: SceneSpec,
    history: History,
    *,
    method: str = "auto",
    structure: Structure | None = None,
    likelihood: str = "auto",
    horizon: int | None = None,
    outliers: str = "none",
    num_chains: int = 4,
    num_warmup: int = 200,
    num_samples: int = 500,
    progress: bool = False,
    mesh: Mesh | None = None,
) -> Posterior:
    """Posterior over densities, joints, wheels, friction, noise, and which exist.

    Hypotheses know no ends of a way. Where a drawer or a door seems to come against
    one, rows in which it may have done so are left out, and a note says how many. (With
    `nuts` and `svi`, and where what is left cannot be inferred from, it is only
    doubted.)

    Args:
        key: random key.
        spec: the scene: outlines, what is known, what may exist.
        history: recorded transitions. An empty one gives the prior.
        method: how. Over structures and numbers: `rj`, reversible jumps; `enumerate`,
            every structure weighed by importance sampling; `smc`, particles tempered
            from the fitted mixture to the posterior; `laplace`, normal bumps on the
            modes, quick and often wrong about odds, which it says; `map`, the single
            best hypothesis. Numbers of one structure by the one-step likelihood:
            `nuts`, see `run_nuts`, and `svi`, see `run_svi`. `auto` is `rj`.
        structure: for `nuts` and `svi`: constraints that exist besides the known ones,
            such as `{"table": ["revolute"]}`; default: the most probable ones.
        likelihood: what is asked of readings. `filtered`: all are noisy, those that a
            step starts from too, and so may be the motion; gaps do no harm. The safe
            choice. `one-step`, equation 1 of the paper: every step is predicted from
            its own first reading as if that were exact. Quicker, and right where
            readings have next to no noise or are fresh starts; with noisy ones it is
            biased, and sure of itself (errors in variables). `open-loop`: predictions
            go on for `horizon` steps, their errors taken as independent. For exact
            motion from exact starts only, or to compare with others: elsewhere errors
            of one prediction are correlated, and 90 % intervals may cover 30 %. The
            last two infer no noise of the motion, integrate the readings' out, and
            leave out rows that nothing read in full leads to; evidence of different
            likelihoods is of different data. `auto` is `filtered`; for `nuts` and
            `svi`, which have no other, `one-step`.
        horizon: for `open-loop`: most steps of a prediction; then the next one starts
            from the reading there. None: from the first reading of a run to its last.
        outliers: `none`: readings have normal noise, and `diagnostics["notes"]` say
            where some are far off; `student-t`: they have Student-t noise of 4 degrees
            of freedom, of which a few gross errors take little away. The noise reported
            is then its scale. With likelihood `filtered` only.
        num_chains: chains, run side by side.
        num_warmup: iterations of each that adapt and are thrown away.
        num_samples: iterations of each that are kept. `enumerate` and `laplace` give
            as many draws, `smc` has as many particles.
        progress: show stages on standard error.
        mesh: devices to spread the work over, of one axis of type Auto; the result does
            not depend on their number. After `jax.distributed.initialize` it may be
            one of all hosts: each makes the same call and gets the whole result.

    Returns:
        Draws of all chains, with diagnostics: not ok, with reasons, also where two
        estimates of odds or evidence disagree beyond their stated errors, or where the
        motion follows a law that the model lacks (`residual`; not with `nuts`, `svi`).

    Raises:
        TypeError: a key, scene, history or mesh that is none.
        ValueError: an unknown method or likelihood, or two that do not go together, a
            horizon or count that is no positive whole number, a history of another
            number of bodies or, for predictions from exact starts, without such, a
            scene with more structures than can be told apart, a prior that makes no
            sense, a mesh of several axes.
    """
    return infer_batch(
        key,
        [spec],
        [history],
        method=method,
        structure=structure,
        likelihood=likelihood,
        horizon=horizon,
        outliers=outliers,
        num_chains=num_chains,
        num_warmup=num_warmup,
        num_samples=num_samples,
        progress=progress,
        mesh=mesh,
    )[0]


def infer_batch(
    key: Key,
    specs: Sequence[SceneSpec],
    histories: Sequence[History],
    *,
    method: str = "auto",
    structure: Structure | None = None,
    likelihood: str = "auto",
    horizon: int | None = None,
    outliers: str = "none",
    num_chains: int = 4,
    num_warmup: int = 200,
    num_samples: int = 500,
    progress: bool = False,
    mesh: Mesh | None = None,
) -> list[Posterior]:
    """The same for many scenes; equal blocks of bodies share one compiled call.

    Histories of different lengths are padded to the longest, so that they share it
    too; one of less than a quarter of that length, to a quarter, and so on. Members
    share padding and random numbers as well: with another recording of one of them the
    draws of the others are others, though of the same law.

    Args:
        key: random key.
        specs: the scenes.
        histories: one for each scene.
        method: as in `infer`.
        structure: as in `infer`, the same for all scenes.
        likelihood: as in `infer`.
        horizon: as in `infer`.
        outliers: as in `infer`.
        num_chains: as in `infer`.
        num_warmup: as in `infer`.
        num_samples: as in `infer`.
        progress: show stages on standard error.
        mesh: as in `infer`.

    Returns:
        One posterior per scene.

    Raises:
        ValueError: as in `infer`, naming the scene by its number where there are
            several, before any of them is inferred; or not as many histories as scenes.
    """
    settings, chosen = checked_options(
        method=method,
        likelihood=likelihood,
        horizon=horizon,
        outliers=outliers,
        num_chains=num_chains,
        num_warmup=num_warmup,
        num_samples=num_samples,
    )
    check_arguments(key, specs, histories, mesh)
    check_structure(specs, method, structure)
    with spread_over(mesh):
        if method in ("nuts", "svi"):
            counts = {
                "num_samples": settings.num_samples,
                "num_chains": settings.num_chains,
            }
            if method == "nuts":
                counts["num_warmup"] = settings.num_warmup
            run = {"nuts": run_nuts, "svi": run_svi}[method]
            missing: list[list[str]] = []
            # Each takes its time: what is wrong with any of them is said before.
            refusals = Refusals(len(specs))
            for index, (spec, history) in enumerate(zip(specs, histories, strict=True)):
                with refusals.of(index):
                    own = [
                        note
                        for body in range(spec.num_bodies)
                        if not spec.is_static[body]
                        for note in chosen.notes_on_rows(spec, (body,), history)
                    ]
                    check_numbers(spec, history, structure)
                    missing.append(own)
            refusals.check()
            posteriors = []
            for index, (spec, history) in enumerate(zip(specs, histories, strict=True)):
                found = run(
                    jax.random.fold_in(key, index),
                    spec,
                    history,
                    structure=structure,
                    progress_bar=progress,
                    **counts,
                )
                posteriors.append(with_notes(found, missing[index]))
        else:
            run_structures = functools.partial(
                _infer_structures,
                settings=settings,
                method="rj" if method == "auto" else method,
                progress=progress,
                freedom=OUTLIERS[outliers],
                likelihood=chosen,
            )
            posteriors = run_structures(key, specs, histories)
            histories = again_between_stops(
                run_structures, key, specs, histories, posteriors
            )
    entries, remedy = chosen.diagnostics, outlier_remedy(chosen.name, method)
    if outliers != "none":
        entries["degrees_of_freedom"] = OUTLIERS[outliers]
    posteriors = [with_diagnostics(posterior, (), entries) for posterior in posteriors]
    for index, (spec, history) in enumerate(zip(specs, histories, strict=True)):
        notes = []
        if outliers == "none":
            notes = [*chosen.notes, *outlier_notes(spec, history, remedy)]
        posteriors[index] = with_doubts(posteriors[index], spec, history, notes)
    seed = seed_of(key)
    return [dataclasses.replace(posterior, seed=seed) for posterior in posteriors]


def checked_options(
    *,
    method: str,
    likelihood: str,
    horizon: int | None,
    outliers: str,
    num_chains: int,
    num_warmup: int,
    num_samples: int,
) -> tuple[SampleSettings, ChosenLikelihood]:
    """Counts and likelihood of `infer`, whose options these are.

    Raises:
        ValueError: as in `infer`.
    """
    if method not in METHODS:
        raise ValueError(
            f"method: expected one of {', '.join(METHODS)}; got {method!r}"
        )
    counts = SampleSettings(
        whole_number("num_chains", num_chains, 1),
        whole_number("num_warmup", num_warmup, 0),
        whole_number("num_samples", num_samples, 1),
    )
    if method == "nuts" and not counts.num_warmup:
        raise ValueError("num_warmup: expected at least 1, got 0")
    if outliers not in OUTLIERS:
        raise ValueError(
            f"outliers: expected one of {', '.join(OUTLIERS)}; got {outliers!r}"
        )
    if method in ("nuts", "svi") and outliers != "none":
        raise ValueError(f"outliers: expected none with method {method!r}")
    return counts, choose_likelihood(
        likelihood, horizon, method=method, outliers=outliers
    )


def _infer_structures(
    key: Key,
    specs: Sequence[SceneSpec],
    histories: Sequence[History],
    settings: SampleSettings,
    *,
    method: str,
    progress: bool,
    freedom: float | None,
    likelihood: ChosenLikelihood,
) -> list[Posterior]:
    """Posteriors over structures, equal blocks of all scenes together."""
    start = time.perf_counter()
    histories = padded_histories(histories)
    batch = blocks_of_batch(specs, histories, likelihood, freedom)
    results: dict[int, list[BlockResult]] = {i: [] for i in range(len(specs))}
    bar = ProgressBar(progress, batch.num_blocks)
    with CompileClock() as clock, bar:
        for number, members in enumerate(batch.groups):
            group_key = jax.random.fold_in(key, number)
            stacked = stack_blocks([block for _, block in members])
            draws = sample_blocks(
                group_key,
                stacked,
                settings,
                bar.stage,
                method=method,
                starts=likelihood.starts,
            )
            bar.stage("looking for further laws")
            checks = check_residuals(stacked, draws)
            for place, (index, block) in enumerate(members):
                result = BlockResult(block, draws, place, checks[place])
                results[index].append(result)
            bar.advance(len(members))
    wall = time.perf_counter() - start
    seconds = {"compile": clock.seconds, "run": max(wall - clock.seconds, 0.0)}
    return [
        assemble_posterior(
            jax.random.fold_in(key, len(batch.groups) + index),
            spec,
            results[index],
            seconds=dict(seconds),
            notes=batch.notes[index],
            method=method,
        )
        for index, spec in enumerate(specs)
    ]


def seed_of(key: Key) -> int:
    """The number that a key was made from, for the record: its words as one."""
    words = np.asarray(jax.random.key_data(key)).ravel()
    return int.from_bytes(words.astype(">u4").tobytes(), "big")


def padded_histories(histories: Sequence[History]) -> list[History]:
    """Histories with few different capacities, none of over four times its own."""
    # An empty table has room for one row, from which shapes can be told.
    longest = max((history.capacity for history in histories), default=1) or 1
    out = []
    for history in histories:
        capacity = longest
        while capacity > 4 and -(-capacity // 4) >= history.capacity:
            capacity = -(-capacity // 4)
        out.append(history.padded(capacity))
    return out

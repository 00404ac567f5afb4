"""Objects of a few kinds: pushing one tells of the others like it."""

import time
from collections.abc import Sequence
from numbers import Real
from typing import Any

import equinox as eqx
import jax
import numpy as np

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.checked_input import whole_number
from boomdp_jax.core.compile_time import CompileClock
from boomdp_jax.core.history import History
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.core.versions import library_versions
from boomdp_jax.inference.arguments import check_arguments
from boomdp_jax.inference.assemble import assemble_posterior
from boomdp_jax.inference.doubts.evidence_report import BlockResult
from boomdp_jax.inference.hypotheses.coordinates import Coordinates
from boomdp_jax.inference.kinds.chains import (
    SAMPLERS,
    KindDraws,
    KindSettings,
    run_kind_chains,
)
from boomdp_jax.inference.kinds.features import number_labels, outline_features
from boomdp_jax.inference.kinds.file import LearntKinds
from boomdp_jax.inference.kinds.noise import own_of_bodies
from boomdp_jax.inference.kinds.objects import (
    SCALE_TOLERANCE,
    BodyAlone,
    ObjectsAlone,
    prior_scales_of,
    resting_pose,
    sample_alone,
)
from boomdp_jax.inference.kinds.posterior import KindsPosterior
from boomdp_jax.inference.kinds.prior import KindPrior, check_kind_prior
from boomdp_jax.inference.kinds.problem import kind_data, settle, structures_in_use
from boomdp_jax.inference.kinds.state import KindData, Tallies
from boomdp_jax.inference.kinds.verdict import (
    kind_notes,
    merged_diagnostics,
    resting_bodies,
    verdict_on_learnt,
    with_kind_doubts,
)
from boomdp_jax.inference.posteriors.contact_numbers import untouched_notes
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.samplers.block_draws import BlockDraws
from boomdp_jax.inference.samplers.chain_diagnostics import diagnose_chains
from boomdp_jax.inference.samplers.structure_chain import ChainDraws
from boomdp_jax.inference.samplers.structure_draws import SampleSettings
from boomdp_jax.physics.scene_spec import SceneSpec

# Draws that the posteriors keep, at most.
_MOST_DRAWS = 2048


def infer_kinds(
    key: Key,
    specs: SceneSpec | Sequence[SceneSpec],
    histories: History | Sequence[History],
    *,
    prior_kinds: LearntKinds | None = None,
    concentration: float | None = None,
    use_labels: bool = True,
    use_outlines: bool = True,
    prior: KindPrior | None = None,
    sampler: str = "collapsed",
    num_chains: int = 32,
    num_warmup: int = 60,
    num_samples: int = 120,
) -> KindsPosterior:
    """Posteriors of all bodies together, objects of one kind being alike.

    A Dirichlet-process mixture: bodies of one kind share which constraints they have
    and, nearly, density, friction, wheels and places of pins on the body; how many
    kinds there are is inferred. Labels and outlines are evidence of a body's kind, so
    that what is learnt of some bodies is known of others that nobody has touched. With
    one body it is the ordinary prior. Bodies are taken not to be tied to each other.

    Prefer `infer` where objects have nothing in common, or are tied.

    Args:
        key: random key.
        specs: the scene, or several whose bodies may have the same constraints.
        histories: one for each scene. Bodies that rest and are not pushed tell nothing.
        prior_kinds: kinds learnt before, `KindsPosterior.kinds` or `load_kinds`; each
            chain takes one draw of them as it is, with what was prior to it. Notes say
            where they were learnt with diagnostics that were not ok.
        concentration: how readily bodies are of new kinds; default: inferred. 0, with
            `prior_kinds`: never, recognition among a fixed list.
        use_labels: whether labels count.
        use_outlines: whether outlines count.
        prior: of kinds; not with `prior_kinds`, which bring theirs.
        sampler: `collapsed` or `sticks`; see `collapsed_gibbs` and `stick_breaking`.
        num_chains: chains, run side by side.
        num_warmup: sweeps of each that are thrown away.
        num_samples: sweeps of each that are kept.

    Returns:
        A posterior of each scene, and which bodies are of one kind; `diagnostics` of
        all scenes, often not ok.

    Raises:
        TypeError: a key, scene, history, kinds or prior that are none.
        ValueError: a body tied to another, or with other possible constraints or
            another prior than the first; kinds learnt of other ones; an option that
            makes no sense.
    """
    specs = [specs] if isinstance(specs, SceneSpec) else specs
    histories = [histories] if isinstance(histories, History) else histories
    check_arguments(key, specs, histories, None)
    if not specs:
        raise ValueError("specs: expected at least one, got none")
    _check_options(prior_kinds, concentration, sampler, prior)
    num_chains = whole_number("num_chains", num_chains, 1)
    num_warmup = whole_number("num_warmup", num_warmup, 0)
    num_samples = whole_number("num_samples", num_samples, 1)
    if prior_kinds is not None:
        prior = prior_kinds.prior
        use_outlines = prior_kinds.num_features > 0 and use_outlines
    prior = KindPrior() if prior is None else prior
    start = time.perf_counter()
    with CompileClock() as clock:
        objects = sample_alone(
            jax.random.fold_in(key, 0),
            specs,
            histories,
            SampleSettings(),
            reach=None if prior_kinds is None else prior_kinds.reach,
        )
        settings = KindSettings(
            num_chains, num_warmup, num_samples, sampler, concentration=concentration
        )
        out = infer_kinds_of(
            jax.random.fold_in(key, 1),
            specs,
            histories,
            objects,
            settings,
            prior,
            use_labels=use_labels,
            use_outlines=use_outlines,
            prior_kinds=prior_kinds,
        )
    wall = time.perf_counter() - start
    seconds = {"compile": clock.seconds, "run": max(wall - clock.seconds, 0.0)}
    for posterior in out.posteriors:
        posterior.seconds.update(seconds)
    return out


def infer_kinds_of(
    key: Key,
    specs: Sequence[SceneSpec],
    histories: Sequence[History],
    objects: ObjectsAlone,
    settings: KindSettings,
    prior: KindPrior,
    *,
    use_labels: bool = True,
    use_outlines: bool = True,
    prior_kinds: LearntKinds | None = None,
) -> KindsPosterior:
    """The second stage alone, on bodies that were sampled by themselves.

    Args:
        key: random key.
        specs: the scenes.
        histories: one for each scene.
        objects: of `sample_alone` on the same.
        settings: how much to draw.
        prior: of kinds.
        use_labels: whether labels count.
        use_outlines: whether outlines count.
        prior_kinds: kinds learnt before.

    Returns:
        As `infer_kinds`.
    """
    specs_of = [specs[body.scene].bodies[body.body] for body in objects.bodies]
    known = () if prior_kinds is None else prior_kinds.labels
    labels = [body.label if use_labels else None for body in specs_of]
    label, names = number_labels(labels, known)
    features = np.stack([outline_features(body) for body in specs_of])
    if not use_outlines:
        features = features[:, :0]
    data = kind_data(objects, label, len(names), features, prior)
    rng = host_generator(jax.random.fold_in(key, 0))
    before = {}
    if prior_kinds is not None:
        before = _before(prior_kinds, data, objects, settings.num_chains)
    draws = run_kind_chains(rng, data, settings, **before)
    kept = np.arange(0, draws.kind.shape[1], _stride(draws))
    has_before = prior_kinds is not None
    posteriors = _posteriors(key, specs, histories, objects, draws, kept, has_before)
    posteriors = [
        with_kind_doubts(
            posterior, histories[scene], resting_bodies(objects, scene), prior_kinds
        )
        for scene, posterior in enumerate(posteriors)
    ]
    ok, reasons = verdict_on_learnt(merged_diagnostics(posteriors), prior_kinds)
    chains = draws.kind[:, kept].reshape(-1, data.num_objects)
    layout = objects.bodies[0].block.layout
    last = draws.state
    return KindsPosterior(
        posteriors=tuple(posteriors),
        bodies=tuple((body.scene, body.name) for body in objects.bodies),
        kind=chains,
        concentration=draws.concentration[:, kept].reshape(-1),
        acceptance=draws.acceptance,
        kinds=LearntKinds(
            tallies=last.tallies,
            spread=last.spread.astype(np.int64),
            concentration=last.concentration.copy(),
            slots=tuple(slot.kind for slot in layout.slots + layout.known_slots),
            labels=names,
            num_features=features.shape[1],
            reach=objects.reach,
            scales=prior_scales_of(objects.bodies[0].block),
            prior=prior,
            versions=library_versions(),
            ok=ok,
            reasons=reasons,
        ),
    )


def _check_options(prior_kinds, concentration, sampler, prior) -> None:
    if prior_kinds is not None and not isinstance(prior_kinds, LearntKinds):
        raise TypeError(
            "prior_kinds: expected LearntKinds, as load_kinds and KindsPosterior.kinds "
            f"give; got {prior_kinds!r}"
        )
    if prior is not None and not isinstance(prior, KindPrior):
        raise TypeError(f"prior: expected a KindPrior; got {prior!r}")
    if sampler not in SAMPLERS:
        raise ValueError(
            f"sampler: expected one of {', '.join(SAMPLERS)}; got {sampler!r}"
        )
    if prior_kinds is not None and (sampler != "collapsed" or prior is not None):
        raise ValueError(
            "prior_kinds: expected the collapsed sampler and no other prior with it"
        )
    least = 0.0 if prior_kinds is not None else np.finfo(float).tiny
    is_number = isinstance(concentration, Real) and not isinstance(concentration, bool)
    if concentration is not None and not (
        is_number and least <= concentration < np.inf
    ):
        raise ValueError(
            "concentration: expected a positive number, or 0 with prior_kinds; got "
            f"{concentration!r}"
        )
    if prior is not None:
        check_kind_prior(prior)


def _before(
    prior_kinds: LearntKinds, data: KindData, objects: ObjectsAlone, num_chains: int
) -> dict:
    """Kinds known before for each chain, with room for labels that are new."""
    tallies, num_features = prior_kinds.tallies, data.feature.shape[1]
    shape = (
        tallies.structure.shape[2],
        tallies.num.shape[2] - prior_kinds.num_features,
    )
    if shape != (len(data.log_prior), data.dim):
        raise ValueError(
            f"prior_kinds: expected kinds of bodies that may have the same constraints "
            f"({data.dim} coordinates), got {', '.join(prior_kinds.slots) or 'none'}"
        )
    for name, scale in prior_scales_of(objects.bodies[0].block).items():
        known = prior_kinds.scales[name]
        if not np.allclose(scale, known, rtol=SCALE_TOLERANCE):
            raise ValueError(
                f"prior_kinds: expected kinds learnt with the prior of {name} of the "
                f"scenes, {scale}; got {known}"
            )
    chosen = np.arange(num_chains) % prior_kinds.num_draws
    columns = data.dim + num_features
    more = data.num_labels + 1 - tallies.label.shape[2]
    label = tallies.label[chosen]
    room = np.zeros((*label.shape[:2], more))
    picked = Tallies(
        count=tallies.count[chosen],
        structure=tallies.structure[chosen],
        label=np.concatenate([label[..., :-1], room, label[..., -1:]], axis=-1),
        num=tallies.num[chosen][..., :columns],
        first=tallies.first[chosen][..., :columns],
        second=tallies.second[chosen][..., :columns],
    )
    return {
        "before": picked,
        "before_spread": prior_kinds.spread[chosen][..., :columns],
        "before_concentration": np.maximum(prior_kinds.concentration[chosen], 1e-9),
    }


def _stride(draws: KindDraws) -> int:
    num_chains, num_draws = draws.kind.shape[:2]
    return max(1, -(-num_chains * num_draws // _MOST_DRAWS))


def _posteriors(
    key: Key,
    specs,
    histories,
    objects: ObjectsAlone,
    draws: KindDraws,
    kept,
    has_before: bool,
) -> list[Posterior]:
    """One posterior per scene, the same draws in all of them."""
    num_chains = draws.kind.shape[0]
    num_draws = num_chains * len(kept)
    dtype = objects.bodies[0].block.target.log_prior.dtype
    structure = draws.structure[:, kept].reshape(num_draws, -1)
    z = draws.z[:, kept].reshape(num_draws, structure.shape[1], -1).astype(dtype)
    log_joint = draws.log_joint[:, kept]
    rng = host_generator(jax.random.fold_in(key, 1))
    likelihood = draws.log_likelihood[:, kept].reshape(num_draws, -1)
    each = own_of_bodies(rng, objects, structure, z, likelihood)
    ordered = np.sort(draws.kind[:, kept], axis=2)
    num_kinds = 1.0 + np.sum(ordered[..., 1:] != ordered[..., :-1], axis=2)
    concentration = np.maximum(draws.concentration[:, kept], 1e-300)
    scalars = {
        "num_kinds": on_device(num_kinds),
        "log_concentration": on_device(np.log(concentration)),
    }
    results: list[list[BlockResult]] = [[] for _ in specs]
    for i, body in enumerate(objects.bodies):
        own = z[:, i]
        target = body.block.target
        if body.bumps is None:
            spec, history = specs[body.scene], histories[body.scene]
            pose = resting_pose(spec, history, body.body)
            coordinates = _coordinates(body)
            in_use = structures_in_use(body.block)[structure[:, i]]
            own = np.where(in_use, settle(coordinates, own, pose), 0.0).astype(dtype)
        shape = (num_chains, len(kept))
        chains = ChainDraws(
            on_device(structure[:, i].reshape(shape), int),
            on_device(own.reshape(*shape, -1), dtype),
            on_device(log_joint),
        )
        # Chains with kinds known before have different draws of them, and are not
        # meant to agree.
        most = np.inf if has_before else 1.05
        verdict = diagnose_chains(target, chains, scalars=scalars, max_r_hat=most)
        block_draws = BlockDraws(
            structure=structure[None, :, i],
            z=own[None],
            log_density=np.zeros((1, num_draws)),
            noise_scale=each[i].noise.reading[None],
            impulse_scale=each[i].noise.impulse[None],
            log_evidence=np.full(1, np.nan),
            evidence=None,
            diagnostics=[verdict],
            chain_index=np.arange(num_chains),
        )
        result = BlockResult(body.block, block_draws, 0, each[i].residual)
        results[body.scene].append(result)
    posteriors = []
    for scene, spec in enumerate(specs):
        posterior = assemble_posterior(
            jax.random.fold_in(key, 2 + scene),
            spec,
            results[scene],
            seconds={},
            notes=[*kind_notes(objects, spec, scene), *untouched_notes(spec)],
            method="kinds",
        )
        posteriors.append(
            eqx.tree_at(
                lambda p: p.log_density,
                posterior,
                on_device(log_joint.reshape(-1), posterior.log_density.dtype),
            )
        )
    return posteriors


def _coordinates(body: BodyAlone) -> Coordinates:
    likelihood: Any = body.block.target.log_likelihood
    return likelihood.coordinates

"""Whether chains over structures can be trusted: R-hat and effective sample sizes.

A slot's coordinates are zero where it is not active, so their R-hat says nothing over
structures. It is taken of the log-density, of each slot's indicator that is not
constant, of any scalar that the caller adds (a total mass, a prediction), and of
coordinates within the most probable structure.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float
from numpyro.diagnostics import effective_sample_size, split_gelman_rubin

from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.moves import MOVES
from boomdp_jax.inference.samplers.structure_chain import ChainDraws

# Draws of each chain below which halves of chains cannot be compared.
_FEWEST_DRAWS = 4


@runtime_checkable
class Counted(Protocol):
    """Proposals made and accepted, `[any, move, 2]`; see `ChainInfo`."""

    @property
    def proposed(self) -> Any:
        """Proposals that were made."""

    @property
    def accepted(self) -> Any:
        """Those that were accepted."""


class ChainDiagnostics(NamedTuple):
    """Verdict, reasons and the numbers behind."""

    ok: bool
    reasons: list[str]
    r_hat: dict[str, float]
    effective_sample_size: dict[str, float]
    acceptance: dict[str, float]
    """Share of proposals accepted by each move that was made, and by those that change
    the structure, as `<move>_structure`."""


def diagnose_chains(
    target: StructureTarget,
    draws: ChainDraws,
    info: Counted | None = None,
    *,
    scalars: dict[str, Float[Array, "chain draw"]] | None = None,
    max_r_hat: float = 1.05,
    min_sample_size: float = 100.0,
) -> ChainDiagnostics:
    """Judge draws of several chains of one object; host side.

    Args:
        target: says which slots a structure has.
        draws: of `run_chains`.
        info: counts of moves; adds acceptance rates and the check for stuck chains.
        scalars: further numbers that mean the same in every structure.
        max_r_hat: largest split R-hat that passes.
        min_sample_size: smallest effective sample size that passes.

    Returns:
        The verdict. `ok` is false with a reason for every number that fails, for a
        log-density that is not finite, for a chain that never moved, and where there
        are too few draws to tell.
    """
    structure = np.asarray(draws.structure)
    log_density = np.asarray(draws.log_density)
    reasons = []
    if not np.all(np.isfinite(log_density)):
        reasons.append("log-density: some draws are not finite")
    series = {"log_density": np.where(np.isfinite(log_density), log_density, -1e30)}
    active = np.asarray(target.structures)[structure]
    for slot in range(active.shape[-1]):
        series[f"slot_{slot}"] = active[..., slot].astype(float)
    series |= {name: np.asarray(value) for name, value in (scalars or {}).items()}
    num_each = structure.shape[1]
    is_judged = num_each >= _FEWEST_DRAWS
    if is_judged:
        series = {name: value for name, value in series.items() if np.ptp(value) > 0}
    series |= _within_structure(target, structure, np.asarray(draws.z))
    r_hat, size, doubts = judge_series(
        series, num_each, max_r_hat=max_r_hat, min_sample_size=min_sample_size
    )
    reasons += doubts
    stuck = np.flatnonzero(np.ptp(log_density, axis=1) == 0)
    # Few draws are equal by chance, and a single one always is.
    if stuck.size and is_judged:
        reasons.append(f"chains {stuck.tolist()} never moved")
    acceptance = {} if info is None else _acceptance(info)
    return ChainDiagnostics(not reasons, reasons, r_hat, size, acceptance)


def judge_series(
    series: Mapping[str, np.ndarray],
    num_each: int,
    *,
    max_r_hat: float = 1.05,
    min_sample_size: float = 100.0,
) -> tuple[dict[str, float], dict[str, float], list[str]]:
    """Split R-hat and effective sample size of numbers, and what is wrong with them.

    Args:
        series: numbers by name, `[chain, draw]`.
        num_each: draws of each chain.
        max_r_hat: largest split R-hat that passes.
        min_sample_size: smallest effective sample size that passes.

    Returns:
        R-hat by name, effective sample size by name, and a reason for every number that
        fails. With too few draws to tell, both are NaN, and a single reason says so.
    """
    if num_each < _FEWEST_DRAWS:
        unknown = dict.fromkeys(series, float("nan"))
        reason = (
            f"too few draws to judge: expected at least {_FEWEST_DRAWS} of each chain, "
            f"got {num_each}"
        )
        return unknown, dict(unknown), [reason]
    r_hat = {name: float(split_gelman_rubin(value)) for name, value in series.items()}
    size = {name: float(effective_sample_size(value)) for name, value in series.items()}
    reasons = []
    for name in series:
        if not r_hat[name] <= max_r_hat:
            reasons.append(f"{name}: R-hat is {r_hat[name]:.3f}, above {max_r_hat}")
        if not size[name] >= min_sample_size:
            reasons.append(
                f"{name}: effective sample size is {size[name]:.0f}, below "
                f"{min_sample_size:.0f}"
            )
    return r_hat, size, reasons


def _within_structure(
    target: StructureTarget, structure: np.ndarray, z: np.ndarray
) -> dict[str, np.ndarray]:
    """Coordinates of the commonest structure, chains cut to equal length.

    Angles enter by sine and cosine, which do not jump where an angle is wrapped; in
    double precision, or the cosine of one close to zero would be all rounding.
    """
    commonest = int(np.argmax(np.bincount(structure.ravel())))
    num_each = np.sum(structure == commonest, axis=1)
    length = int(num_each.min())
    if length < 8:
        return {}
    rows = [
        chain_z[chain_structure == commonest][:length]
        for chain_z, chain_structure in zip(z, structure, strict=True)
    ]
    kept, period = np.stack(rows), np.asarray(target.period)
    series = {}
    slot, active = np.asarray(target.slot), np.asarray(target.structures)[commonest]
    is_used = np.append(active, True)[slot]
    for index in np.flatnonzero(is_used):
        value = kept[..., index].astype(np.float64)
        if period[index] > 0:
            turn = 2.0 * np.pi * value / period[index]
            series[f"z_{index}_cos"] = np.cos(turn)
            series[f"z_{index}_sin"] = np.sin(turn)
        else:
            series[f"z_{index}"] = value
    return {name: value for name, value in series.items() if np.ptp(value) > 0}


def _acceptance(info: Counted) -> dict[str, float]:
    proposed = np.sum(np.asarray(info.proposed), axis=0)
    accepted = np.sum(np.asarray(info.accepted), axis=0)
    rates = {}
    for index, name in enumerate(MOVES):
        if proposed[index].sum() > 0:
            rates[name] = float(accepted[index].sum() / proposed[index].sum())
        if proposed[index, 1] > 0:
            rates[f"{name}_structure"] = float(accepted[index, 1] / proposed[index, 1])
    return rates

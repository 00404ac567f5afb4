"""Inferring again from rows between stops, for what comes against some."""

import dataclasses
from collections.abc import Callable, Sequence

import jax

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.history import History
from boomdp_jax.inference.doubts.all_doubts import with_notes
from boomdp_jax.inference.doubts.end_stops import without_stops
from boomdp_jax.inference.failures import all_but_refused
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.physics.scene_spec import SceneSpec

# Rows between stops, at least, to be inferred from alone; and what parts the random
# numbers of that from those before.
_FEWEST_FREE, _STOPS_KEY = 20, 0x5709


def again_between_stops(
    run_structures: Callable[..., list[Posterior]],
    key: Key,
    specs: Sequence[SceneSpec],
    histories: Sequence[History],
    posteriors: list[Posterior],
) -> list[History]:
    """Put posteriors of what comes against stops right, in place.

    Rows between stops may be refused where all rows were not, such as where predictions
    start from exact readings and none of those is between the stops. Then the posterior
    of all rows stays, of which `end_stop_reasons` has its doubts.

    Args:
        run_structures: infers scenes from a key, their specs and their histories.
        key: random key that the posteriors were inferred with.
        specs: the scenes.
        histories: all rows of each.
        posteriors: what was inferred of them.

    Returns:
        The rows that were inferred from.
    """
    kept, again, between = list(histories), {}, {}
    for index, posterior in enumerate(posteriors):
        free, notes = without_stops(posterior, histories[index])
        if notes and free.num_transitions >= _FEWEST_FREE:
            again[index], between[index] = notes, free
    if not again:
        return kept
    again_key = jax.random.fold_in(key, _STOPS_KEY)
    # Refused are members of this second pass, which have other numbers there.
    found, refused = all_but_refused(
        list(again),
        lambda numbers: run_structures(
            again_key,
            [specs[index] for index in numbers],
            [between[index] for index in numbers],
        ),
    )
    for index, posterior in found.items():
        kept[index] = between[index]
        before = posteriors[index].seconds
        seconds = {name: before[name] + s for name, s in posterior.seconds.items()}
        posterior = dataclasses.replace(posterior, seconds=seconds)
        posteriors[index] = with_notes(posterior, again[index])
    for index, line in refused.items():
        note = f"no rows are left out at stops, since those between are refused: {line}"
        posteriors[index] = with_notes(posteriors[index], [note])
    return kept

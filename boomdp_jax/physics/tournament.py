r"""All pairs of bodies, in rounds in which no body meets two others.

The circle method of a round-robin tournament: bodies sit at two rows of a table, those
opposite each other meet, and after each round all but one move on by a seat. With an
even number B there are B - 1 rounds of B / 2 pairs, after which all sit where they
began. Within a round pairs have no body in common, so one operation treats them all.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# From so many rounds on they are a loop: a step of eight bodies then compiles in half
# the time and is faster, one of the living room's sixteen is three times as fast. Of
# four or six bodies it is slower so.
_MANY_ROUNDS = 7

Halves = tuple[Any, Any]
"""Two trees of arrays `[pair, ...]`: who sits in the first row, who opposite."""


def num_seats(num_bodies: int) -> int:
    """Bodies with one to make them even."""
    return num_bodies + num_bodies % 2


def num_rounds(num_bodies: int) -> int:
    """How many rounds there are."""
    return num_seats(num_bodies) - 1


def seated(tree: Any, num_bodies: int) -> Halves:
    """Seat bodies for the first round; an odd number is filled up with zeros.

    Args:
        tree: arrays `[body, ...]`.
        num_bodies: how many.

    Returns:
        Both rows.
    """
    num = num_seats(num_bodies)

    def halves(array):
        if num > num_bodies:
            array = jnp.concatenate([array, jnp.zeros_like(array[:1])])
        return array[: num // 2], array[num // 2 :][::-1]

    return tuple(
        jax.tree.map(lambda array, i=i: halves(array)[i], tree) for i in range(2)
    )


def unseated(halves: Halves, num_bodies: int) -> Any:
    """Undo `seated`, after all rounds."""
    return jax.tree.map(
        lambda a, b: jnp.concatenate([a, b[::-1]])[:num_bodies], *halves
    )


def moved_on(halves: Halves) -> Halves:
    """Seats of the next round."""
    first, second = halves
    return (
        jax.tree.map(
            lambda a, b: (
                jnp.concatenate([a[:1], b[:1], a[1:-1]]) if a.shape[0] > 1 else a
            ),
            first,
            second,
        ),
        jax.tree.map(lambda a, b: jnp.concatenate([b[1:], a[-1:]]), first, second)
        if jax.tree.leaves(first)[0].shape[0] > 1
        else second,
    )


def pairs(num_bodies: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Who meets whom, round by round.

    Args:
        num_bodies: how many bodies.

    Returns:
        Indices of both rows; one that is `num_bodies` is nobody.
    """
    num = num_seats(num_bodies)
    first, second = np.arange(num // 2), np.arange(num // 2, num)[::-1]
    for _ in range(num - 1):
        yield first, second
        if num > 2:
            first, second = (
                np.concatenate([first[:1], second[:1], first[1:-1]]),
                np.concatenate([second[1:], first[-1:]]),
            )


def play(
    turn: Callable[[Any, Any], tuple[Any, Any]], carry: Any, rounds: Sequence[Any]
) -> tuple[Any, list]:
    """Play all rounds, one after another.

    Args:
        turn: from what is carried and what belongs to a round, to what is carried on
            and what comes of the round.
        carry: to begin with.
        rounds: what belongs to each; trees of arrays of equal shapes.

    Returns:
        What is carried in the end, and what came of each round.
    """
    if len(rounds) < _MANY_ROUNDS:
        results = []
        for one in rounds:
            carry, result = turn(carry, one)
            results.append(result)
        return carry, results
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rounds)
    carry, found = jax.lax.scan(turn, carry, together)
    return carry, [
        jax.tree.map(lambda leaf, i=i: leaf[i], found) for i in range(len(rounds))
    ]

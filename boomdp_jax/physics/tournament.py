r"""All pairs of bodies, in rounds in which no body meets two others.

The circle method of a round-robin tournament: bodies sit at two rows of a table, those
opposite each other meet, and after each round all but one move on by a seat. With an
even number B there are B - 1 rounds of B / 2 pairs, after which all sit where they
began. Within a round pairs have no body in common, so one operation treats them all.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.physics.many_bodies import is_many

Halves = tuple[Any, Any]
"""Two trees of arrays `[pair, ...]`: who sits in the first row, who opposite."""


class Stacked(NamedTuple):
    """All rounds of a tournament of many in one tree."""

    tree: Any
    """Arrays `[round, pair, ...]`."""


Rounds = list | Stacked
"""What belongs to each round: one tree of `[pair, ...]` after another, or stacked."""


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


def each_round(tree: Any, num_bodies: int) -> Rounds:
    """Who sits where in every round.

    Args:
        tree: arrays `[body, ...]` of one shape.
        num_bodies: how many.

    Returns:
        Both rows (`Halves`) of each round.
    """
    if not is_many(num_bodies):
        halves, rounds = seated(tree, num_bodies), []
        for _ in range(num_rounds(num_bodies)):
            rounds.append(halves)
            halves = moved_on(halves)
        return rounds
    leaves, treedef = jax.tree.flatten(tree)
    table = jnp.stack(leaves)
    if num_bodies < num_seats(num_bodies):
        table = jnp.concatenate([table, jnp.zeros_like(table[:, :1])], axis=1)
    rows = (np.stack(row) for row in zip(*pairs(num_bodies), strict=True))
    first, second = (
        jax.tree.unflatten(treedef, list(table[:, seats])) for seats in rows
    )
    return Stacked((first, second))


def as_rounds(tree: Any, num_bodies: int) -> Rounds:
    """What belongs to each round, of arrays `[round, pair, ...]`."""
    if is_many(num_bodies):
        return Stacked(tree)
    return [
        jax.tree.map(lambda leaf, i=i: leaf[i], tree)
        for i in range(num_rounds(num_bodies))
    ]


def stacked(rounds: Rounds) -> Any:
    """What belongs to each round, as a tree of arrays `[round, pair, ...]`."""
    if isinstance(rounds, Stacked):
        return rounds.tree
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rounds)


def least(rounds: Rounds) -> Any:
    """Smallest of all rounds, of arrays `[...]` of each."""
    if isinstance(rounds, Stacked):
        return jax.tree.map(lambda leaf: jnp.min(leaf, axis=0), rounds.tree)
    return functools.reduce(lambda p, q: jax.tree.map(jnp.minimum, p, q), rounds)


def play(
    turn: Callable[[Any, tuple], tuple[Any, tuple]], carry: Any, *own: Rounds
) -> tuple[Any, tuple[Rounds, ...]]:
    """Play all rounds, one after another.

    Args:
        turn: from what is carried and all that belongs to a round, to what is carried
            on and a tuple of what comes of the round.
        carry: to begin with.
        own: what belongs to each.

    Returns:
        What is carried in the end, and what came of each round.
    """
    if all(isinstance(rounds, Stacked) for rounds in own):
        carry, found = jax.lax.scan(turn, carry, tuple(stacked(one) for one in own))
        return carry, tuple(Stacked(part) for part in found)
    results = []
    for one in zip(*own, strict=True):
        carry, result = turn(carry, one)
        results.append(result)
    return carry, tuple(list(part) for part in zip(*results, strict=True))

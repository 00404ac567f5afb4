"""From how many bodies on a step is made of loops and reductions.

Few bodies are written out one by one, which is faster in both directions. Of many that
takes long to compile, and a step waits for thousands of small operations: with loops
and reductions one of eight bodies compiles in half of the time and is faster, and one
of sixteen is three times as fast.
"""

_MANY = 7


def is_many(num_bodies: int) -> bool:
    """Whether there are so many.

    Args:
        num_bodies: how many.
    """
    return num_bodies >= _MANY

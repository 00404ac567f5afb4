"""In how many parts a step is to be made for how far bodies turn in it."""

import numpy as np

# What a push does by way of a rod, a wheel or a joint of two bodies turns with them,
# and a part of a step takes it as it is in the middle, which leaves out a share of the
# square of the turn over 24 (but for a lone body's pin, see `lone_step`). Two boxes on
# a pin, at 0.45 rad a part, were 6 mrad off after one, a rod 5. So far a part may turn
# [rad], from a turn in a step on that matters; parts are a power of two, since each
# number is a program, and so many at most.
_TURN_OF_PART, _LEAST_TURN, _MOST_PARTS = 0.15, 0.2, 8
_SHARE_OF_STEPS = 0.9
"""Share of steps in which bodies turn by less than what counts."""


def parts_for_turns(turns: np.ndarray) -> int:
    """How many parts steps should have.

    Args:
        turns: by how much bodies turn in steps [rad], `[step, body]`; NaN: not known.

    Returns:
        A power of two; 1 where nothing turns fast, which the engine's own substeps, two
        where a scene says nothing, are enough for.
    """
    size = np.abs(np.asarray(turns, float))
    found = [
        float(np.quantile(own[np.isfinite(own)], _SHARE_OF_STEPS))
        for own in size.T
        if np.any(np.isfinite(own))
    ]
    most = max(found, default=0.0)
    if most < _LEAST_TURN:
        return 1
    return min(1 << int(np.ceil(np.log2(most / _TURN_OF_PART))), _MOST_PARTS)


def note_of_parts(num_parts: int) -> str:
    """That steps are cut for how far bodies turn, and how to say otherwise.

    Args:
        num_parts: in how many parts they are made.
    """
    return (
        f"steps are made in {num_parts} parts for how far bodies turn in one; "
        '"substeps" in the scene makes them in as many as it says'
    )

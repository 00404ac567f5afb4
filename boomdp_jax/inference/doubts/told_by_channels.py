"""One coordinate of a body from any of its channels, each with its own error."""

import numpy as np
from jaxtyping import Float, Int

Told = tuple[Float[np.ndarray, " reading"], Float[np.ndarray, " reading"]]
"""Values and their errors; NaN where they are not told."""

# What is so many times as uncertain as the usual is not told.
_MOST = 3.0
# Readings that channels are compared on, at least, and steps of Newton's.
_FEWEST, _STEPS = 12, 2


def along_line(
    values: Float[np.ndarray, "reading 2"],
    centre: Float[np.ndarray, "2"],
    along: Float[np.ndarray, "2"],
    noise: float,
) -> Told:
    """Where on a line, or how fast along it, from both channels or the one read.

    One alone is also off by how far the thing is across the line.

    Args:
        values: positions, or velocities.
        centre: a point of the line; zero for velocities.
        along: its direction.
        noise: of each channel; not finite where it is not known, nor then are errors.
    """
    off = values - centre
    place = off @ along
    error = np.where(np.isfinite(place), noise, np.nan)
    across = off @ np.array([-along[1], along[0]])
    is_both = np.isfinite(across)
    if is_both.sum() < _FEWEST or not np.isfinite(noise):
        return place, error
    width = np.sqrt(max(np.mean(across[is_both] ** 2) - noise**2, 0.0))
    for channel in (0, 1):
        share = abs(along[channel])
        own = np.hypot(noise, abs(along[1 - channel]) * width)
        if own > _MOST * noise * share:
            continue
        use = np.isnan(place) & np.isfinite(off[:, channel])
        place = np.where(use, off[:, channel] / along[channel], place)
        error = np.where(use, own / share, error)
    return place, error


def about_pin(
    angle: Float[np.ndarray, " reading"],
    positions: Float[np.ndarray, "reading 2"],
    run: Int[np.ndarray, " reading"],
    time: Float[np.ndarray, " reading"],
    noise: float,
) -> tuple[Told, Float[np.ndarray, "reading 2"]]:
    """How far it is turned, from its angle or from where its middle is.

    Args:
        angle: unwrapped.
        positions: of its middle, which goes round the pin.
        run: of each reading.
        time: of each reading.
        noise: of angles.

    Returns:
        The angle and its error, and levers from the pin as the positions have them.
    """
    error = np.where(np.isfinite(angle), noise, np.nan)
    guess = between(angle, run, time)
    cos, sin, one = np.cos(guess), np.sin(guess), np.ones_like(guess)
    none = np.zeros_like(guess)
    # Pin and arm are told best by the positions themselves.
    rows = np.stack(
        [
            np.stack([one, none, cos, -sin], -1),
            np.stack([none, one, sin, cos], -1),
        ],
        1,
    )
    use = np.isfinite(angle)[:, None] & np.isfinite(positions)
    lever = np.full((len(angle), 2), np.nan)
    if use.sum() < 2 * _FEWEST:
        return (angle, error), lever
    found = np.linalg.lstsq(rows[use], positions[use], rcond=1e-9)[0]
    left = (positions - np.nan_to_num(rows) @ found)[use]
    spread = max(float(np.sqrt(np.mean(left**2))), np.finfo(float).tiny)
    out = angle.copy()
    need = np.isnan(angle) & np.isfinite(guess)
    for _ in range(_STEPS):
        cos, sin = np.cos(guess), np.sin(guess)
        lever = np.stack(
            [cos * found[2] - sin * found[3], sin * found[2] + cos * found[3]], -1
        )
        tangent = np.stack([-lever[:, 1], lever[:, 0]], -1)
        off = positions - found[:2] - lever
        is_read = np.isfinite(off) & need[:, None]
        strength = np.sum(np.where(is_read, tangent, 0.0) ** 2, 1)
        step = np.sum(np.where(is_read, tangent * off, 0.0), 1)
        good = spread < _MOST * noise * np.sqrt(strength)
        guess = guess + np.where(good, step / np.where(good, strength, 1.0), 0.0)
        out = np.where(good, guess, out)
        own = spread / np.sqrt(np.where(good, strength, 1.0))
        error = np.where(good, np.maximum(own, noise), error)
    return (out, error), lever


def spin_about_pin(
    spin: Float[np.ndarray, " reading"],
    velocities: Float[np.ndarray, "reading 2"],
    lever: Float[np.ndarray, "reading 2"],
    noise: float,
) -> Told:
    """How fast it turns, from its spin or from how fast its middle goes."""
    error = np.where(np.isfinite(spin), noise, np.nan)
    tangent = np.stack([-lever[:, 1], lever[:, 0]], -1)
    off = velocities - tangent * spin[:, None]
    both = off[np.isfinite(off)]
    if len(both) < 2 * _FEWEST or not np.isfinite(noise):
        return spin, error
    spread = max(float(np.sqrt(np.mean(both**2))), np.finfo(float).tiny)
    is_read = np.isfinite(velocities) & np.isfinite(tangent)
    is_read &= np.isnan(spin)[:, None]
    strength = np.sum(np.where(is_read, tangent, 0.0) ** 2, 1)
    good = spread < _MOST * noise * np.sqrt(strength)
    own = np.sum(np.where(is_read, tangent * velocities, 0.0), 1)
    root = np.where(good, strength, 1.0)
    return (
        np.where(good, own / root, spin),
        np.where(good, np.maximum(spread / np.sqrt(root), noise), error),
    )


def between(
    values: Float[np.ndarray, " reading"],
    run: Int[np.ndarray, " reading"],
    time: Float[np.ndarray, " reading"],
) -> Float[np.ndarray, " reading"]:
    """With gaps inside runs filled along straight lines; NaN in runs of nothing."""
    out = values.copy()
    for each in np.unique(run):
        mine = np.flatnonzero(run == each)
        known = mine[np.isfinite(values[mine])]
        if len(known):
            out[mine] = np.interp(time[mine], time[known], values[known])
    return out

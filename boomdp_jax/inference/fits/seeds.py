"""First guesses from the readings: where pins, rods, axles would have to be."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.inference.fits.rod_guess import rod_guess
from boomdp_jax.inference.hypotheses.coordinates import Coordinates
from boomdp_jax.inference.hypotheses.layout import BODY_NUMBERS, SlotKey
from boomdp_jax.inference.hypotheses.meeting import anchor_scale, met_at, rod_length
from boomdp_jax.inference.readings.single_steps import Readings
from boomdp_jax.physics.params import WORLD

# Distances [m] and speeds [m/s] that weigh the same in a guess: what a camera resolves.
_POSITION_NOISE = 1e-3
_VELOCITY_NOISE = 5e-3


def _rotation(angle: Float[Array, " time"]) -> Float[Array, "time 2 2"]:
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack(
        [jnp.stack([cos, -sin], axis=-1), jnp.stack([sin, cos], axis=-1)], axis=-2
    )


@full_precision
def pin_guess(
    data: Readings, body_a: int, body_b: int, reach: Float[Array, " body"]
) -> tuple[Float[Array, " 2"], Float[Array, " 2"]]:
    r"""Anchors that keep $x_a + R_a r_a - x_b - R_b r_b$ and its rate nearest to zero.

    Args:
        data: readings of a block.
        body_a: one body.
        body_b: the other, or `WORLD`, whose anchor is then a fixed world point.
        reach: prior scale of the anchors [m], a weak ridge.

    Returns:
        Both anchors [m].
    """
    mask = data.mask[:, body_a, 0]
    columns, rates = [], []
    eye = jnp.broadcast_to(jnp.eye(2), (mask.shape[0], 2, 2))
    for body, sign in ((body_a, 1.0), (body_b, -1.0)):
        if body == WORLD:
            columns.append(sign * eye)
            rates.append(jnp.zeros_like(eye))
            continue
        rotation = _rotation(data.state[:, body, 2])
        turned = jnp.stack([-rotation[:, 1], rotation[:, 0]], axis=1)
        columns.append(sign * rotation)
        rates.append(sign * data.state[:, body, 5, None, None] * turned)
    offset, speed = data.state[:, body_a, 0:2], data.state[:, body_a, 3:5]
    if body_b != WORLD:
        offset = offset - data.state[:, body_b, 0:2]
        speed = speed - data.state[:, body_b, 3:5]
    a = jnp.concatenate(
        [
            jnp.concatenate(columns, axis=-1) / _POSITION_NOISE,
            jnp.concatenate(rates, axis=-1) / _VELOCITY_NOISE,
        ],
        axis=1,
    )
    b = jnp.concatenate([offset / _POSITION_NOISE, speed / _VELOCITY_NOISE], axis=1)
    a, b = a * mask[:, None, None], b * mask[:, None]
    ridge = jnp.stack([reach[body_a]] * 2 + [reach[body_b]] * 2) ** -2.0
    normal = jnp.einsum("tij,tik->jk", a, a) + jnp.diag(ridge)
    solution = -jnp.linalg.solve(normal, jnp.einsum("tij,ti->j", a, b))
    return solution[:2], solution[2:]


@full_precision
def axle_guess(data: Readings, body: int) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Heading across which a body moves least, and how far along it that holds.

    Args:
        data: readings of a block.
        body: which body.

    Returns:
        Heading [rad] and the offset of the axle along it [m], body frame.
    """
    mask = data.mask[:, body, 3]
    rotation = _rotation(data.state[:, body, 2])
    local = jnp.einsum("tij,ti->tj", rotation, data.state[:, body, 3:5]) * mask[:, None]
    spin = data.state[:, body, 5] * mask
    turning = jnp.sum(spin**2) + 1e-12
    lever = (spin @ local) / turning
    scatter = local.T @ local - turning * jnp.outer(lever, lever)
    # Smallest principal axis of a 2 x 2 matrix, in closed form.
    heading = 0.5 * jnp.arctan2(2 * scatter[0, 1], scatter[0, 0] - scatter[1, 1])
    normal = jnp.stack([-jnp.sin(heading), jnp.cos(heading)])
    return heading, -normal @ lever


def seed_coordinates(
    coordinates: Coordinates, data: Readings
) -> tuple[Float[Array, " dim"], Bool[Array, " dim"]]:
    """Coordinates at the guesses, and which coordinates have one.

    Args:
        coordinates: the block's map.
        data: its readings.

    Returns:
        Guesses (zero where there is none) and a mask.
    """
    layout, around = coordinates.layout, coordinates.surroundings
    reach = around.radius + around.spread
    z = jnp.zeros(layout.dim)
    has = jnp.zeros(layout.dim, bool)
    for slot in layout.slots + layout.known_slots:
        if slot.kind == "revolute":
            values = _pin_seed(coordinates, data, slot, reach)
            where = slice(slot.start, slot.start + 4)
        elif slot.kind == "distance":
            values = _rod_seed(coordinates, data, slot, reach)
            where = slice(slot.start, slot.start + 5)
        elif slot.kind == "wheel":
            values = _wheel_seed(coordinates, data, slot)
            where = slice(slot.start, slot.start + 3)
        elif slot in layout.rests:
            # Coordinates are measured from where the readings put it.
            values, where = jnp.zeros(3), slice(slot.start, slot.start + 3)
        else:
            continue
        z = z.at[where].set(values)
        has = has.at[where].set(True)
    for number in layout.numbers:
        # Where the prior has it: nothing is known better without a fit.
        where = slice(number.start, number.start + BODY_NUMBERS[number.name])
        has = has.at[where].set(True)
    return jnp.clip(z, -6.0, 6.0), has


def _pin_seed(coordinates: Coordinates, data: Readings, slot: SlotKey, reach):
    around, scales = coordinates.surroundings, coordinates.scales
    padded = jnp.concatenate([reach, reach[slot.body_a][None]])  # WORLD is the last.
    first, second = pin_guess(data, slot.body_a, slot.body_b, padded)
    frame = around.meeting[coordinates.layout.meetings.index(slot)]
    middle, unit = anchor_scale(slot, frame, reach)
    off = (second - met_at(frame, first)) / around.radius[slot.body_a]
    return jnp.concatenate(
        [
            scales.standard("revolute.anchor", (first - middle) / unit),
            jnp.arcsinh(scales.standard("revolute.offset", off)),
        ]
    )


def _rod_seed(coordinates: Coordinates, data: Readings, slot: SlotKey, reach):
    around, scales, a = coordinates.surroundings, coordinates.scales, slot.body_a
    origin, other = around.center[a], reach[a]
    if slot.body_b != WORLD:
        origin, other = jnp.zeros(2), reach[slot.body_b]
    unit = jnp.stack([reach[a], other])
    noise = _POSITION_NOISE, _VELOCITY_NOISE
    first, second, length = rod_guess(data, a, slot.body_b, unit, origin, noise)
    frame = around.meeting[coordinates.layout.meetings.index(slot)]
    met = rod_length(frame, first, second, around.radius[a])
    return jnp.concatenate(
        [
            scales.standard("distance.anchor", first / reach[a]),
            scales.standard("distance.anchor", (second - origin) / other),
            scales.standard("distance.length", jnp.log(length / met))[None],
        ]
    )


@full_precision
def _wheel_seed(coordinates: Coordinates, data: Readings, slot: SlotKey):
    around, body = coordinates.surroundings, slot.body_a
    heading, along = axle_guess(data, body)
    direction = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    middle = around.box_center[body]
    position = middle + direction * (along - direction @ middle)
    z = coordinates.scales.standard(
        "wheel.position",
        (position - middle) / around.half_extents[body],
    )
    heading = heading - jnp.pi * jnp.floor(heading / jnp.pi + 0.5)
    return jnp.concatenate([z, heading[None]])


def random_starts(
    rng: np.random.Generator,
    guess: Float[np.ndarray, " dim"],
    has: Bool[np.ndarray, " dim"],
    period: Float[np.ndarray, " dim"],
    num: int,
) -> Float[np.ndarray, "start dim"]:
    """Draws from the prior, in half of which guesses take the place of draws.

    Args:
        rng: source of randomness.
        guess: of `seed_coordinates`.
        has: which coordinates have a guess.
        period: of coordinates that are angles, 0 for all others.
        num: how many.

    Returns:
        The starts.
    """
    shape = (num, len(guess))
    angle = period * (rng.random(shape) - 0.5)
    z = np.where(period > 0, angle, rng.standard_normal(shape))
    jitter = guess + 0.02 * rng.standard_normal(shape)
    return np.where(has & (np.arange(num) % 2 == 0)[:, None], jitter, z)

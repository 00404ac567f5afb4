"""Recordings of a free box under known forces, in closed form, and scenes of it."""

import numpy as np

from boomdp_jax.core.history import History, make_history
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict

DT, MASS = 0.02, 3.0
SIZE = (0.3, 0.2)
AREA = 4.0 * SIZE[0] * SIZE[1]
INERTIA = MASS * (SIZE[0] ** 2 + SIZE[1] ** 2) / 3.0
NOISE = np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3])


def lacking(
    history: History, way: str, body: int = 0, seed: int = 0
) -> tuple[History, History]:
    """A chained recording with channels missing at one end of instants, and in full.

    Args:
        history: of one reading an instant, nothing missing.
        way: `next` or `start`: ends, or starts of rows that go on, have no velocities;
            `some`: any channel of either may be missing.
        body: which of its bodies lacks them.
        seed: of what is missing.

    Returns:
        It, and the same readings with both ends of an instant made equal.
    """
    state, last = np.array(history.state), np.array(history.next_state)
    now, after = state[:, body], last[:, body]
    goes_on = np.diff(np.asarray(history.episode), prepend=-1) == 0
    rng = np.random.default_rng(seed)
    if way == "next":
        after[:, 3:] = np.nan
    elif way == "start":
        now[goes_on, 3:] = np.nan
    else:
        after[rng.random(after.shape) < 0.3] = np.nan
        now[(rng.random(now.shape) < 0.3) & goes_on[:, None]] = np.nan

    def table(first, second):
        action, episode = np.asarray(history.action), np.asarray(history.episode)
        dt = np.asarray(history.dt)
        return make_history(first, action, second, dt, episode=episode)

    full_state, full_last = state.copy(), last.copy()
    rows = np.flatnonzero(goes_on)
    instant = np.where(np.isnan(state[rows]), last[rows - 1], state[rows])
    full_state[rows] = full_last[rows - 1] = instant
    return table(state, last), table(full_state, full_last)


def box_scene(
    unknown: dict[str, int] | None = None,
    *,
    constraints: list[dict] | None = None,
    **body,
) -> SceneSpec:
    """A box seen from above whose density is unknown."""
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": DT,
            "bodies": [
                {"name": "box", "shape": {"type": "box", "half_extents": SIZE}, **body}
            ],
            "constraints": constraints or [],
            "unknown": unknown or {},
        },
        source="test",
    )


def transition_matrix() -> np.ndarray:
    """Of a free body's channels over one step."""
    matrix = np.eye(6)
    matrix[:3, 3:] = DT * np.eye(3)
    return matrix


def response(mass: float = MASS) -> np.ndarray:
    """Change of the channels per wrench held over a step, `[6, 3]`."""
    inertia = INERTIA * mass / MASS
    inverse = np.diag([1.0 / mass, 1.0 / mass, 1.0 / inertia])
    return np.concatenate([0.5 * DT**2 * inverse, DT * inverse])


def free_box(
    rng: np.random.Generator,
    num_rows: int,
    *,
    is_chained: bool = True,
    noise: np.ndarray = NOISE,
    num_episodes: int = 1,
) -> History:
    """Readings of a free box under random wrenches."""
    action = rng.normal(size=(num_rows, 3)) * [20.0, 20.0, 3.0]
    episode = np.arange(num_rows) * num_episodes // num_rows
    state, next_state = np.zeros((num_rows, 6)), np.zeros((num_rows, 6))
    now = np.zeros(6)
    for t in range(num_rows):
        if t == 0 or episode[t] != episode[t - 1]:
            now = rng.normal(size=6) * 0.3
        state[t] = now
        now = transition_matrix() @ now + response() @ action[t]
        next_state[t] = now
    state = state + noise * rng.normal(size=state.shape)
    next_state = next_state + noise * rng.normal(size=state.shape)
    if is_chained:
        follows = np.flatnonzero(np.diff(episode) == 0) + 1
        state[follows] = next_state[follows - 1]
    return make_history(
        state[:, None],
        action[:, None],
        next_state[:, None],
        DT,
        episode=episode,
    )

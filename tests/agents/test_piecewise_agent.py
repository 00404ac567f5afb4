"""A room put in order by one who knows it; long, since all of it is compiled."""

import jax
import numpy as np
import pytest

from boomdp_jax.agents import run_episode
from boomdp_jax.experiments import agent_of, make_task


@pytest.mark.slow
def test_who_knows_the_room_puts_every_piece_in_its_place():
    with jax.enable_x64(False):
        task = make_task("living-room", 250)
        params = task.default_params()
        agent = agent_of("true", task, params)
        record, _ = run_episode(jax.random.key(3), task, params, agent)
    assert record.num_done < task.num_steps
    # Costs come down from the first step on, and no piece does all the work.
    cost = -record.reward[: record.num_done]
    assert cost[0] > 0.5
    assert cost[-1] == 0
    assert cost[len(cost) // 2] < cost[0] / 2
    pushed = record.action[: record.num_done] // 10
    assert len(np.unique(pushed)) >= task.num_pieces

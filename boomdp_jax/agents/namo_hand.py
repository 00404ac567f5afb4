"""What the robot's hand felt, put beside what its eyes told of the same steps.

Poses may be told some steps late, forces are felt at once. The robot knows its delay,
so it keeps what it felt until the poses of those steps have come.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from boomdp_jax.agents.namo_touch import pressed_steps
from boomdp_jax.envs.namo import NOBODY, NamoWorld
from boomdp_jax.envs.namo_drive import NUM_STEPS, Driven
from boomdp_jax.models.thing_belief import Row
from boomdp_jax.physics.state import State


class Hand:
    """Pairs what was felt with what is told, command after command.

    Args:
        world: the room, of which it takes outlines.
        delay: of poses and twists, in steps of the world.
    """

    def __init__(self, world: NamoWorld, delay: int):
        self._world, self._delay = world, delay
        # Of the steps whose poses are still to come.
        self._felt = np.zeros((delay, 3))
        self._held = np.full(delay, NOBODY)
        self._num_steps = 0
        # Thing and step of the last reading that became a row.
        self._last_told = (NOBODY, -1)

    def paired(self, driven: Driven) -> Driven:
        """A command's readings with what was felt when they were true.

        To be called once for every command, in order.
        """
        felt = np.concatenate([self._felt, np.asarray(driven.reading.wrench)])
        held = np.concatenate([self._held, np.asarray(driven.reading.held)])
        self._felt, self._held = felt[NUM_STEPS:], held[NUM_STEPS:]
        self._num_steps += NUM_STEPS
        now = (jnp.asarray(felt[:NUM_STEPS]), jnp.asarray(held[:NUM_STEPS]))
        reading = eqx.tree_at(lambda r: (r.wrench, r.held), driven.reading, now)
        return driven._replace(reading=reading)

    def rows(self, thing: int, driven: list[Driven]) -> list[Row]:
        """What the last commands tell of a thing.

        Args:
            thing: index of the body.
            driven: those commands, in order, as `paired` returned them.

        Returns:
            Steps throughout which it was held, without those in which it was pressed
            against another thing.
        """
        rows = []
        step = self._num_steps - self._delay - NUM_STEPS * len(driven)
        for reading in (one.reading for one in driven):
            pressed = pressed_steps(
                self._world.scene,
                reading.before,
                reading.after,
                jnp.asarray(thing),
                self._world.robot,
                reading.wrench[:, :2],
            )
            told = (np.asarray(reading.held) == thing) & ~np.asarray(pressed)
            for index in np.flatnonzero(told).tolist():
                before, after = (
                    State(part.pose[index, thing][None], part.twist[index, thing][None])
                    for part in (reading.before, reading.after)
                )
                begins = self._last_told != (thing, step + index - 1)
                self._last_told = (thing, step + index)
                rows.append(Row(before, reading.wrench[index][None], after, begins))
            step += NUM_STEPS
        return rows

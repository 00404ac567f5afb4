"""Four tasks for planners: what moves, what it costs, where it starts.

- `pendulum`: a bob on a joint, pushed by forces spread round the unit circle, each too
  weak to lift it; a step costs the angle from upright [rad].
- `point`: a double integrator in a pocket whose open end looks away from the goal.
- `cart`: a box with fixed wheels at one end, in the papers' walled room (1 pixel there
  is 1 cm here); pushed at its centre, a wall stops it dead.
- `acrobot`: two links on a joint, a torque between them; a step costs how far the tip
  is below the highest place that it can reach.

Pendulum, cart and acrobot are scenes of our engine, stepped by the public `step`; the
point mass is two lines of arithmetic. Leaf values: `zero`; `straight`, minus the cost
of standing there for some steps; `geodesic`, the same for the way round the walls, on a
flood-filled grid (where there are walls).
"""

from _planning_swings import acrobot, pendulum
from _planning_task import Task
from _planning_walls import axle_hypotheses, cart, point

__all__ = ["TASKS", "Task", "axle_hypotheses"]

TASKS = {"pendulum": pendulum, "point": point, "cart": cart, "acrobot": acrobot}

"""What is seen of a scene: outlines, supports, gravity and time step, as arrays."""

import equinox as eqx
from jaxtyping import Array, Bool, Float


class Scene(eqx.Module):
    """The observed part of a world, arrays only, so that scenes stack and vmap.

    Every body's outline is in the frame whose origin is its centre of mass. A circle
    has a `radius` and no vertices; a polygon has a radius of zero.
    """

    vertices: Float[Array, "*batch body vertex 2"]
    """Corners, counter-clockwise [m]; unused ones repeat the last."""
    vertex_mask: Bool[Array, "*batch body vertex"]
    radius: Float[Array, "*batch body"]
    """Radius of a circle [m], zero for a polygon."""
    area: Float[Array, "*batch body"]
    """Area of the outline [m²]."""
    gyration: Float[Array, "*batch body"]
    """Squared radius of gyration about the centre of mass, inertia over mass [m²]."""
    feet: Float[Array, "*batch body foot 2"]
    """Where the body stands on the floor, body frame [m]."""
    foot_load: Float[Array, "*batch body foot"]
    """Share of the weight on each foot; sums to one over a body's feet."""
    is_static: Bool[Array, "*batch body"]
    gravity: Float[Array, "*batch 2"]
    """In-plane gravity [m/s²]."""
    normal_gravity: Float[Array, "*batch"]
    """Gravity across the plane, the load on floor and wheels [m/s²]."""
    dt: Float[Array, "*batch"]
    """Default length of a step [s]."""
    collides: Bool[Array, "*batch body body"] | None = None
    """Which bodies may touch each other, symmetric; None: there is no contact. Bodies
    that a joint connects do not touch, whatever this says."""
    foot_size: Float[Array, "*batch body foot"] | None = None
    """Lever of a foot's friction against its own spin, zero for a point [m]: it rubs at
    the speed sqrt(v² + size² spin²). None: all are points."""
    corner_load: Float[Array, "*batch body foot"] | None = None
    """Share of the weight on each foot where only the outermost carry: `foot_load` of
    feet that a scene gives, what stands on legs at its corners otherwise
    (`Ground.corner_share`). None: `foot_load`."""
    diagonal: Float[Array, "*batch body foot"] | None = None
    """What is more on each foot, over its load, where as much as possible is on one
    diagonal, which leaves the centre of the load where it is; zero for three feet
    (`Ground.diagonal_share`). None: all zero."""
    stance_axis: Float[Array, "*batch body"] | None = None
    """Direction of the longer axis of the outline, body frame [rad]; None: zero."""
    smoothing: Float[Array, "*batch"] | None = None
    """Speed s by which contact is smoothed [m/s]; None: not at all. Bodies then push
    each other before they touch, at a gap d with an acceleration of s²/d, and friction
    gives way a little before its limit, so that there are derivatives of what does not
    touch yet (`step`)."""
    num_substeps: int = eqx.field(static=True, default=2)
    """Equal parts into which a step is cut."""
    num_sweeps: int = eqx.field(static=True, default=1)
    """Iterations over all contacts in which a substep finds where bodies go."""

    @property
    def num_bodies(self) -> int:
        """How many bodies there is room for."""
        return self.area.shape[-1]

"""Array aliases: the shapes and dtypes that the rest of the package speaks in."""

from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

FloatScalar = Float[Array, ""]
IntScalar = Int[Array, ""]
BoolScalar = Bool[Array, ""]
Vector2 = Float[Array, "*batch 2"]
Key = PRNGKeyArray

__all__ = ["BoolScalar", "FloatScalar", "IntScalar", "Key", "Vector2"]

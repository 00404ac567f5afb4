"""Which likelihood of the readings is meant, and what goes with it."""

from typing import NamedTuple

import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.inference.likelihoods.exact_starts import ExactStarts, covered_rows
from boomdp_jax.inference.readings.track_data import track_data
from boomdp_jax.inference.readings.unread import is_unread
from boomdp_jax.physics.scene_spec import SceneSpec

LIKELIHOODS = ("auto", "filtered", "one-step", "open-loop")
"""What is asked of readings: `auto` is `filtered`, with `nuts` and `svi` `one-step`."""

_OF_ONE_STRUCTURE = ("nuts", "svi")
_TOO_NARROW = (
    "open-loop likelihood: errors of predictions are taken as independent; where the "
    "motion itself is noisy they are not, and intervals are too narrow"
)


class ChosenLikelihood(NamedTuple):
    """What was asked for; made by `choose_likelihood`."""

    name: str
    """Any of `LIKELIHOODS` but `auto`."""
    horizon: int | None

    @property
    def starts(self) -> ExactStarts | None:
        """Where predictions start; None: states are latent."""
        if self.name == "filtered":
            return None
        return ExactStarts(1 if self.name == "one-step" else self.horizon)

    @property
    def diagnostics(self) -> dict:
        """Entries that say which it was."""
        horizon = {"horizon": self.horizon} if self.name == "open-loop" else {}
        return {"likelihood": self.name, **horizon}

    @property
    def notes(self) -> list[str]:
        """What a user must know of it."""
        return [_TOO_NARROW] if self.name == "open-loop" else []

    def notes_on_rows(
        self, spec: SceneSpec, bodies: tuple[int, ...], history: History
    ) -> list[str]:
        """Make sure that predictions of a block of bodies have something to start from.

        Args:
            spec: the scene.
            bodies: those of the block.
            history: of the whole scene.

        Returns:
            A note where rows are left out, since no prediction leads through them.

        Raises:
            ValueError: there are readings, and none of them can be predicted; or there
                are rows, and no reading of any body.
        """
        if self.starts is None:
            return []
        data = track_data(history, bodies, is_uniform=False)
        is_read = np.any(np.asarray(data.last_mask) > 0, axis=(1, 2))
        left = is_read & ~covered_rows(data, self.starts)
        num, num_left = int(np.sum(is_read)), int(np.sum(left))
        names = "+".join(spec.names[body] for body in bodies)
        # Of a body that was not seen while others were, the prior is as good as ever.
        if num_left == num and (num or is_unread(spec, history)):
            raise ValueError(
                f"{spec.source}: {names}: likelihood {self.name!r}: expected rows that "
                "start from a reading of every pose, velocity and spin; got none; "
                "likelihood 'filtered' does without"
            )
        if not num_left:
            return []
        return [
            f"{names}: {num_left} of {num} rows do not count: what their prediction "
            "would start from was not read in full"
        ]


def choose_likelihood(
    likelihood: str, horizon: int | None, *, method: str, outliers: str
) -> ChosenLikelihood:
    """The likelihood that is meant, if it goes with everything else.

    Args:
        likelihood: one of `LIKELIHOODS`.
        horizon: most steps of an open-loop prediction; None: no limit.
        method: of inference.
        outliers: law of the readings' noise.

    Returns:
        The same, `auto` resolved.

    Raises:
        ValueError: an unknown likelihood, a horizon that is no positive whole number or
            has no meaning, or a combination that does not exist.
    """
    if likelihood not in LIKELIHOODS:
        raise ValueError(
            f"likelihood: expected one of {', '.join(LIKELIHOODS)}; got {likelihood!r}"
        )
    has_one_structure = method in _OF_ONE_STRUCTURE
    if has_one_structure and likelihood not in ("auto", "one-step"):
        raise ValueError(
            f"likelihood: expected auto or one-step with method {method!r}, got "
            f"{likelihood!r}; methods over structures take it"
        )
    if likelihood == "auto":
        likelihood = "one-step" if has_one_structure else "filtered"
    if likelihood != "open-loop" and horizon is not None:
        raise ValueError(
            f"horizon: expected none with likelihood {likelihood!r}, which is for "
            f"open-loop; got {horizon!r}"
        )
    is_whole = isinstance(horizon, int | np.integer) and not isinstance(horizon, bool)
    if horizon is not None and not (is_whole and horizon >= 1):
        raise ValueError(
            f"horizon: expected a whole number, at least 1, or None; got {horizon!r}"
        )
    if likelihood != "filtered" and outliers != "none":
        raise ValueError(
            f"outliers: expected none with likelihood {likelihood!r}, got "
            f"{outliers!r}; likelihood 'filtered' takes it"
        )
    return ChosenLikelihood(likelihood, horizon)


def outlier_remedy(likelihood: str, method: str) -> str:
    """What to do about gross errors, in words that `choose_likelihood` accepts.

    Args:
        likelihood: any of `LIKELIHOODS` but `auto`.
        method: of inference.
    """
    if method in _OF_ONE_STRUCTURE:
        return "outliers='student-t' with likelihood='filtered' and method='auto'"
    if likelihood == "filtered":
        return "outliers='student-t'"
    return "outliers='student-t' with likelihood='filtered'"

"""What is known of objects and of their kinds: posteriors, partitions, summaries."""

import collections
import os

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.inference.kinds.file import LearntKinds
from boomdp_jax.inference.kinds.verdict import first_few, merged_diagnostics
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.posteriors.summary import plain
from boomdp_jax.inference.posteriors.table import note_lines, verdict_line


class KindsPosterior(eqx.Module):
    """Posteriors of scenes whose bodies tell of each other, and the bodies' kinds.

    Kinds have no numbers of their own: which body is of kind 1 differs from draw to
    draw. What is reported holds whatever the numbers: which bodies go together, how
    many kinds there are, and what the bodies of a group are like.
    """

    posteriors: tuple[Posterior, ...]
    """One of each scene, the same draws in all of them."""
    bodies: tuple[tuple[int, str], ...] = eqx.field(static=True)
    """Scene and name of each movable body."""
    kind: Int[np.ndarray, "draw body"]
    """Which bodies are of one kind, draw by draw."""
    concentration: Float[np.ndarray, " draw"]
    """Of the Dirichlet process."""
    acceptance: Float[np.ndarray, " body"]
    """Share of proposals accepted; one for bodies without readings."""
    kinds: LearntKinds = eqx.field(static=True)
    """A prior for other scenes: `infer_kinds(..., prior_kinds=)`."""

    @property
    def posterior(self) -> Posterior:
        """Of the first scene."""
        return self.posteriors[0]

    @property
    def diagnostics(self) -> dict:
        """`ok` where all scenes are, `reasons` and `notes` of all, worst numbers."""
        return merged_diagnostics(self.posteriors)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the bodies; with the number of the scene where there are several."""
        if len(self.posteriors) == 1:
            return tuple(name for _, name in self.bodies)
        return tuple(f"{scene}.{name}" for scene, name in self.bodies)

    def co_clustering(self) -> Float[np.ndarray, "body body"]:
        """Probability that two bodies are of one kind."""
        num_bodies = self.kind.shape[1]
        out = np.zeros((num_bodies, num_bodies))
        for row in range(num_bodies):
            out[row] = np.mean(self.kind == self.kind[:, row : row + 1], axis=0)
        return out

    def num_kinds(self) -> dict[int, float]:
        """Probability of each number of kinds among the bodies."""
        ordered = np.sort(self.kind, axis=1)
        count = 1 + np.sum(ordered[:, 1:] != ordered[:, :-1], axis=1)
        values, times = np.unique(count, return_counts=True)
        return {
            int(v): float(t / len(count)) for v, t in zip(values, times, strict=True)
        }

    def groups(self) -> list[list[int]]:
        """One partition that stands for all: the draw nearest to `co_clustering`.

        Least squares, Dahl (2006), Model-based clustering for expression data via a
        Dirichlet process mixture model, section 4. Largest groups first.
        """
        together = self.co_clustering()
        distance = np.array(
            [
                np.sum((together - (row[:, None] == row[None])) ** 2)
                for row in np.unique(self._numbered(), axis=0)
            ]
        )
        best = np.unique(self._numbered(), axis=0)[np.argmin(distance)]
        found = [np.flatnonzero(best == k).tolist() for k in np.unique(best)]
        return sorted(found, key=lambda group: (-len(group), group[0]))

    def _numbered(self) -> np.ndarray:
        """Kinds numbered by their first body."""
        first = np.argmax(self.kind[:, :, None] == self.kind[:, None, :], axis=2)
        return first

    def to_json(self) -> dict:
        """Groups with what their bodies are like, in numbers that JSON holds."""
        together = self.co_clustering()
        groups = []
        for members in self.groups():
            inner = together[np.ix_(members, members)]
            density = np.concatenate([self._density(i) for i in members])
            structures: dict[str, float] = collections.defaultdict(float)
            for i in members:
                for name, p in self._structure(i).items():
                    structures[name] += p / len(members)
            likely = sorted(structures.items(), key=lambda item: -item[1])[:3]
            groups.append(
                {
                    "members": [self.names[i] for i in members],
                    "togetherness": float(inner.min()),
                    "density": {
                        "q05": float(np.quantile(density, 0.05)),
                        "q50": float(np.quantile(density, 0.5)),
                        "q95": float(np.quantile(density, 0.95)),
                    },
                    "structure": dict(likely),
                }
            )
        return {
            "schema": "boomdp-kinds-report-1",
            "num_kinds": {str(k): p for k, p in self.num_kinds().items()},
            "concentration": float(np.median(self.concentration)),
            "groups": groups,
            "diagnostics": plain(self.diagnostics),
        }

    def summary(self) -> str:
        """A table for people: kinds, groups of bodies, diagnostics of all scenes."""
        report = self.to_json()
        lines = [
            "kinds  "
            + "  ".join(f"{k}: {p:.2f}" for k, p in report["num_kinds"].items())
        ]
        for number, group in enumerate(report["groups"], start=1):
            density = group["density"]
            what = ", ".join(
                f"{n or 'free'} {p:.2f}" for n, p in group["structure"].items()
            )
            lines += [
                f"group {number}  {', '.join(group['members'])}",
                f"    together with probability {group['togetherness']:.2f} or more",
                f"    density {density['q50']:.3g} ({density['q05']:.3g} to "
                f"{density['q95']:.3g}) kg/m²",
                f"    {what}",
            ]
        verdict = report["diagnostics"]
        # Every number of every body may have a reason: a hundred would be no table.
        reasons = first_few(verdict["reasons"], "diagnostics['reasons']")
        notes = first_few(verdict.get("notes", []), "diagnostics['notes']")
        lines += ["", verdict_line(verdict["ok"], reasons), *note_lines(notes)]
        return "\n".join(lines)

    def save(self, path: str | os.PathLike) -> None:
        """Write what was learnt of the kinds; see `load_kinds`."""
        self.kinds.save(path)

    def _density(self, body: int) -> np.ndarray:
        scene, name = self.bodies[body]
        posterior = self.posteriors[scene]
        return np.asarray(posterior.params.density)[:, posterior.spec.index(name)]

    def _structure(self, body: int) -> dict[str, float]:
        """Probability of each set of inferred constraints of one body."""
        scene, name = self.bodies[body]
        posterior = self.posteriors[scene]
        index, params = posterior.spec.index(name), posterior.params
        words: np.ndarray = np.full(posterior.num_draws, "", dtype=object)
        for kind, inferred in posterior.inferred.items():
            group = getattr(params, kind)
            active = np.asarray(group.active)
            if inferred.ndim == 1:
                owner = np.asarray(group.body_a) == index
                count = np.sum(active & owner & inferred, axis=1)
            else:
                count = np.sum(active[:, index] & inferred[index], axis=1)
            for times in np.unique(count[count > 0]):
                words[count == times] += f" {kind}" * int(times)
        found = collections.Counter(word.strip() for word in words)
        return {word: times / posterior.num_draws for word, times in found.items()}

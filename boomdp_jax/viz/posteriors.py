"""What is believed about one body, drawn on its outline."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.posteriors.structure_report import (
    Slots,
    axle_offsets,
    constraint_draws,
    group_by_structure,
    relabel,
)
from boomdp_jax.inference.posteriors.summary import (
    axial_difference,
    axial_mean,
    weighted_quantiles,
)
from boomdp_jax.physics.constraint_spec import JOINTS, KINDS
from boomdp_jax.physics.params import WORLD, Params
from boomdp_jax.viz.style import BY_KIND, EDGE, FLOOR, OUTLINE_STYLE, PIN, SLIDE, WHEEL

_LEAST_DRAWN = 0.05
"""Probability below which a constraint is left out of the picture."""
_NUM_POINTS = 150
"""Draws in a cloud: enough to see its shape, few enough to see through."""


def draw_posterior(
    ax: Any,
    posterior: Posterior,
    *,
    body: int = 0,
    truth: Params | Mapping[str, Any] | None = None,
) -> None:
    """Draw a body's outline with inferred pins, rods, wheels and floor friction.

    A pin, a rod's end or a weld is a cloud of draws with its 90 % ellipse; a drawer is
    its line, as the body has it where it was seen. A wheel is its axle
    line, the 90 % band of that line, and an arrow along its heading. A cross is the
    centre of mass, the mean one where it is inferred. All is in the frame of the
    outline as authored.

    Args:
        ax: a `matplotlib.axes.Axes`.
        posterior: what is believed.
        body: index of the body.
        truth: what holds, drawn as hollow markers: `Params`, or a mapping with `pin`
            `[x, y]` or `wheel` `[x, y, heading]` in the outline's frame [m, rad].
    """
    spec = posterior.spec.bodies[body]
    params = jax.tree.map(np.asarray, posterior.params)
    weights = posterior.weights
    center = spec.shift
    if params.center_of_mass is not None:
        center = center + weights @ params.center_of_mass[:, body]
    reach = _draw_outline(ax, spec, center)
    every = {kind: np.ones_like(slots) for kind, slots in posterior.inferred.items()}
    for slots, probability in _likely(params, every, weights, body):
        rows, draws = constraint_draws(slots, params, every)
        weight = weights[rows] / weights[rows].sum()
        draws, _ = relabel(draws, weight, None)
        for place in range(slots.count):
            mine = {key: value[:, place] for key, value in draws.items()}
            if slots.kind == "prismatic":
                label = _joint_label(slots, posterior.spec.names, body)
                is_first = slots.body_a == body
                _draw_slide(ax, mine, weight, spec, is_first, label, probability)
            elif slots.kind in JOINTS:
                key = "anchor_a" if slots.body_a == body else "anchor_b"
                anchor = mine[key] + spec.shift
                label = _joint_label(slots, posterior.spec.names, body)
                _draw_cloud(ax, anchor, weight, slots.kind, label, probability)
            elif slots.kind == "wheel":
                _draw_wheel(ax, mine, weight, spec.shift, reach, probability)
            else:
                _draw_floor(ax, spec, mine["dry"], weight, probability)
    if truth is not None:
        _draw_truth(ax, _truth_points(truth, body, spec.shift), reach)
    ax.set_xlabel("x in the outline's frame [m]")
    ax.set_ylabel("y in the outline's frame [m]")
    ax.set_title(_title(posterior, body), fontsize=10)
    ax.set_aspect("equal", adjustable="datalim")
    if ax.get_legend_handles_labels()[0]:
        # Under the axes, below the label of the x axis, however tall the axes are.
        ax.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, 0.0),
            borderaxespad=5.5,
            labelspacing=0.8,
            fontsize=8,
            frameon=False,
        )


def _likely(
    params: Params, every: Mapping[str, np.ndarray], weights: np.ndarray, body: int
) -> list[tuple[Slots, float]]:
    """Constraints on a body that are probable, with their most probable count."""
    totals: dict[tuple, dict[int, float]] = {}
    for group in group_by_structure(params, every, weights):
        for slots in group.slots:
            if body in (slots.body_a, slots.body_b):
                counts = totals.setdefault(slots[:3], {})
                counts[slots.count] = counts.get(slots.count, 0.0) + group.probability
    result = []
    for (kind, body_a, body_b), counts in totals.items():
        probability = sum(counts.values())
        if probability >= _LEAST_DRAWN:
            count = max(counts, key=lambda number, counts=counts: counts[number])
            result.append((Slots(kind, body_a, body_b, count), probability))
    return sorted(result, key=lambda entry: KINDS.index(entry[0].kind))


def _draw_outline(ax: Any, spec: Any, center: np.ndarray) -> float:
    """Outline and centre of mass; returns how far the outline reaches [m]."""
    from matplotlib.patches import Circle, Polygon

    if spec.kind == "circle":
        ax.add_patch(Circle((0.0, 0.0), spec.radius, **OUTLINE_STYLE))
        low, high = np.full(2, -spec.radius), np.full(2, spec.radius)
    else:
        ax.add_patch(Polygon(spec.outline, closed=True, **OUTLINE_STYLE))
        low, high = spec.outline.min(axis=0), spec.outline.max(axis=0)
    margin = 0.12 * float(np.max(high - low))
    ax.update_datalim(np.array([low - margin, high + margin]))
    ax.autoscale_view()
    ax.plot(*center, marker="+", color=EDGE, markersize=7, zorder=2)
    return 0.5 * float(np.max(high - low))


def _draw_cloud(
    ax: Any,
    points: np.ndarray,
    weight: np.ndarray,
    kind: str,
    label: str,
    probability: float,
) -> None:
    """Draws of a point, their mean, and the ellipse that holds 90 % of a normal."""
    from matplotlib.patches import Ellipse

    colour = BY_KIND[kind]
    mean = weight @ points
    covariance = (points - mean).T @ ((points - mean) * weight[:, None])
    variance, axes = np.linalg.eigh(covariance)
    # 4.605 = the 90 % quantile of a chi-square with two degrees of freedom.
    size = 2.0 * np.sqrt(4.605 * np.maximum(variance, 0.0))
    turn = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
    chosen = points[_some(weight)]
    ax.scatter(*chosen.T, s=6, color=colour, alpha=0.25, linewidths=0, zorder=4)
    ellipse = Ellipse((mean[0], mean[1]), size[1], size[0], angle=turn, zorder=5)
    ellipse.set(fill=False, edgecolor=colour)
    ax.add_patch(ellipse)
    spread = 1e3 * np.sqrt(np.diag(covariance))
    text = (
        f"{label} {probability:.2f}: ({mean[0]:.3f}, {mean[1]:.3f}) m "
        f"± ({spread[0]:.1f}, {spread[1]:.1f}) mm"
    )
    ax.plot(
        *mean,
        marker="o",
        markersize=6,
        color=colour,
        linestyle="",
        label=text,
        zorder=6,
    )


def _draw_slide(
    ax: Any,
    numbers: dict[str, np.ndarray],
    weight: np.ndarray,
    spec: Any,
    is_first: bool,
    label: str,
    probability: float,
) -> None:
    """The mean line of a drawer through its mean anchor on this body."""
    # The line is fixed in the partner, and the body in its angle against that.
    turned = numbers["axis"] - (numbers["angle"] if is_first else 0.0)
    centre = axial_mean(turned, weight)
    spread = np.sqrt(weight @ axial_difference(turned, centre) ** 2)
    anchor = weight @ numbers["anchor_a" if is_first else "anchor_b"] + spec.shift
    direction = np.array([np.cos(centre), np.sin(centre)])
    ends = anchor + spec.reach * np.array([[-1.0], [1.0]]) * direction
    ax.plot(
        *ends.T,
        color=SLIDE,
        linewidth=2,
        label=(
            f"{label} {probability:.2f}: axis {np.degrees(centre):.2f}° "
            f"± {np.degrees(spread):.2f}°"
        ),
        zorder=6,
    )


def _draw_wheel(
    ax: Any,
    numbers: dict[str, np.ndarray],
    weight: np.ndarray,
    shift: np.ndarray,
    reach: float,
    probability: float,
) -> None:
    """Axle line, its 90 % band, and an arrow along the heading."""
    position, heading = numbers["pose"][:, :2], numbers["pose"][:, 2]
    centre = axial_mean(heading, weight)
    along, across = axle_offsets(position[:, 0], position[:, 1], heading, centre)
    turn = np.mod(heading - centre + 0.5 * np.pi, np.pi) - 0.5 * np.pi
    rolling = np.array([np.cos(centre), np.sin(centre)])
    axle = np.array([-np.sin(centre), np.cos(centre)])
    places = np.linspace(-1.15 * reach, 1.15 * reach, 41)
    # Where a draw's axle line, across_i from the centre of mass and turned by turn_i,
    # cuts the line at `places` along the mean axle.
    steep = np.clip(np.cos(turn), 0.05, None)
    offset = (across[:, None] + places[None] * np.sin(turn)[:, None]) / steep[:, None]
    low, middle, high = weighted_quantiles(offset, weight, (0.05, 0.5, 0.95))

    def point(offset: np.ndarray) -> np.ndarray:
        return shift + offset[:, None] * rolling + places[:, None] * axle

    bound = 1.6 * reach
    band = [point(np.clip(low, -bound, bound)), point(np.clip(high, -bound, bound))]
    ax.fill(
        *np.concatenate([band[0], band[1][::-1]]).T,
        color=WHEEL,
        alpha=0.2,
        linewidth=0,
        zorder=2,
    )
    # Half-widths of 90 % intervals: a few draws with the axles swapped do not count.
    ends = weighted_quantiles(np.stack([across, turn], -1), weight, (0.05, 0.95))
    spread, angle = 0.5 * (ends[1] - ends[0]) * np.array([1e3, 180.0 / np.pi])
    ax.plot(
        *point(middle).T,
        color=WHEEL,
        alpha=0.3 + 0.7 * min(probability, 1.0),
        linewidth=1.6,
        zorder=3,
        label=(
            f"wheel's axle {probability:.2f}: ± {spread:.1f} mm, "
            f"heading {np.degrees(centre):.1f}° ± {angle:.1f}° (90 %)"
        ),
    )
    middle_along = weighted_quantiles(along[:, None], weight, (0.5,))[0, 0]
    start_along = np.clip(middle_along, -0.6 * reach, 0.6 * reach)
    start = shift + (weight @ across) * rolling + start_along * axle
    ax.annotate(
        "",
        xy=start + 0.4 * reach * rolling,
        xytext=start,
        arrowprops={"arrowstyle": "-|>", "color": WHEEL, "linewidth": 2},
        zorder=6,
    )


def _draw_floor(
    ax: Any, spec: Any, dry: np.ndarray, weight: np.ndarray, probability: float
) -> None:
    """Feet of a body that rubs on the floor."""
    mean = weight @ dry
    sd = np.sqrt(weight @ (dry - mean) ** 2) if np.isfinite(mean) else np.nan
    number = f"coefficient {mean:.2f} ± {sd:.2f}" if np.isfinite(mean) else "viscous"
    feet = spec.feet + spec.shift
    ax.plot(
        *feet.T,
        marker="s",
        markersize=5,
        linestyle="",
        color=FLOOR,
        label=f"floor friction {probability:.2f}: {number}",
        zorder=4,
    )


def _draw_truth(ax: Any, points: dict[str, list[np.ndarray]], reach: float) -> None:
    """True pins as hollow circles, true wheels as dashed axles with a hollow square."""
    hollow = {"markerfacecolor": "none", "markeredgewidth": 1.6, "linestyle": ""}
    for number, pin in enumerate(points["pin"]):
        ax.plot(
            *pin[:2],
            marker="o",
            markersize=13,
            markeredgecolor=PIN,
            label=None if number else "true pin",
            zorder=7,
            **hollow,
        )
    for number, wheel in enumerate(points["wheel"]):
        axle = np.array([-np.sin(wheel[2]), np.cos(wheel[2])])
        ends = wheel[:2] + reach * np.array([[-1.0], [1.0]]) * axle
        ax.plot(*ends.T, color=EDGE, linestyle="--", linewidth=1.2, zorder=3.5)
        ax.plot(
            *wheel[:2],
            marker="s",
            markersize=10,
            markeredgecolor=WHEEL,
            label=None if number else "true wheel and its axle",
            zorder=7,
            **hollow,
        )


def _truth_points(
    truth: Params | Mapping[str, Any], body: int, shift: np.ndarray
) -> dict[str, list[np.ndarray]]:
    """True pins and wheels of a body, in the outline's frame."""
    if not isinstance(truth, Params):
        return {
            name: [np.asarray(truth[name], float)]
            if truth.get(name) is not None
            else []
            for name in ("pin", "wheel")
        }
    pins = []
    for ends, anchors in (
        (truth.revolute.body_a, truth.revolute.anchor_a),
        (truth.revolute.body_b, truth.revolute.anchor_b),
    ):
        chosen = np.asarray(truth.revolute.active) & (np.asarray(ends) == body)
        pins += list(np.asarray(anchors)[chosen] + shift)
    active = np.asarray(truth.wheel.active)[body]
    place = np.asarray(truth.wheel.position)[body][active] + shift
    heading = np.asarray(truth.wheel.heading)[body][active]
    return {"pin": pins, "wheel": list(np.column_stack([place, heading]))}


def _some(weight: np.ndarray) -> np.ndarray:
    """Some draws, one from each of so many equal shares of the weight."""
    count = min(_NUM_POINTS, len(weight))
    inside = np.random.default_rng(0).uniform(size=count)
    levels = (np.arange(count) + inside) / count
    return np.minimum(np.searchsorted(np.cumsum(weight), levels), len(weight) - 1)


def _joint_label(slots: Slots, names: tuple[str, ...], body: int) -> str:
    words = {"revolute": "pin", "distance": "rod", "prismatic": "slide", "weld": "weld"}
    word = words[slots.kind]
    other = slots.body_b if slots.body_a == body else slots.body_a
    return word if other == WORLD else f"{word} to {names[other]}"


def _title(posterior: Posterior, body: int) -> str:
    """Name and mass of a body."""
    spec = posterior.spec.bodies[body]
    if spec.is_static:
        return f"{spec.name} (static)"
    mass = np.asarray(posterior.params.density, np.float64)[:, body] * spec.area
    low, middle, high = weighted_quantiles(
        mass[:, None], posterior.weights, (0.05, 0.5, 0.95)
    )[:, 0]
    return f"{spec.name}: mass {middle:.4g} kg (90 %: {low:.4g} to {high:.4g})"

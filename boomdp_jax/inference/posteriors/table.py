"""A posterior's report as a table for people."""

import numpy as np

from boomdp_jax.inference.posteriors.summary import CHANNELS, IMPULSES, Summary

_UNITS = {
    "revolute": {"viscous": "N m s/rad", "dry": "N m"},
    "distance": {},
    "prismatic": {"viscous": "N s/m", "dry": "N"},
    "weld": {},
    "wheel": {"viscous": "N s/m", "dry": "N"},
    "ground": {"viscous": "N s/m", "dry": ""},
}
_TITLES = {
    "anchor_a": "anchor on a",
    "anchor_b": "anchor on b",
    "length": "length",
    "axis": "axis",
    "angle": "angle against b",
    "pose": "place and heading",
    "along_axle": "along its axle",
    "across_axle": "across its axle",
    "viscous": "viscous friction",
    "dry": "dry friction limit",
}
# What a number does not say of itself.
_NOTES = {("prismatic", "anchor_b"): " (a point of its line; where on it is agreed)"}
_BODY_TITLES = {
    "center_of_mass": ("centre of mass", ["m", "m"]),
    "actuator.gain": ("actuator gain", [""]),
    "actuator.bias": ("actuator bias", ["N", "N", "N m"]),
    "actuator.delay": ("actuator delay", ["s"]),
}
_NOISE_UNITS = dict(
    zip(
        (*CHANNELS, *IMPULSES),
        ("m", "rad", "m/s", "rad/s", "m/s", "rad/s"),
        strict=True,
    )
)
_LEAST_SHOWN = 0.001
"""Probability below which a structure is left out of the table (not of the object)."""
_MOST_SHOWN = 10


def format_report(report: dict, structures: dict[str, float], num_draws: int) -> str:
    """Write a report as a table for people.

    Args:
        report: a `boomdp-infer-1` object.
        structures: probability of each structure by name, most probable first.
        num_draws: how many draws it rests on.

    Returns:
        Lines of text without a final newline.
    """
    lines = [f"{'body':<16}{'mass [kg]':<32}{'density [kg/m²]':<32}identified"]
    for name, body in report["bodies"].items():
        lines.append(
            f"{name:<16}{_interval(body['mass']):<32}{_interval(body['density']):<32}"
            f"{'yes' if body['identified'] else 'no: ' + _whose(body['mass'])}"
        )
    for name, body in report["bodies"].items():
        for key, (title, units) in _BODY_TITLES.items():
            if key in body:
                lines.append(f"{name:<16}{title:<20}{_quantity(body[key], units)}")
    lines += ["", *_structure_lines(structures)]
    for entry in report["structure"][:1]:
        if entry["constraints"]:
            lines += ["", "constraints of the most probable structure"]
            lines += _constraint_lines(entry["constraints"])
    if report["known_constraints"]:
        lines += ["", "known constraints with inferred numbers"]
        lines += _constraint_lines(report["known_constraints"])
    if "contact" in report:
        lines += ["", "contact"]
    for name, number in report.get("contact", {}).items():
        bodies = ", ".join(number["bodies"])
        lines.append(f"  {name:<20}{_quantity(number, [''])} ({bodies})")
    if "mass_ratios" in report:
        lines += ["", "ratios of masses"]
    for ratio in report.get("mass_ratios", []):
        name = " / ".join(ratio["bodies"])
        lines.append(f"  {name:<20}{_quantity(ratio, [''])}")
    freedom = report["diagnostics"].get("degrees_of_freedom")
    lines += ["", f"noise of one reading ({_noise_meaning(freedom)})"]
    for name, noise in report["noise"].items():
        parts = [
            f"{channel.replace('_', ' ')} {_quantity(noise[channel], [unit])}"
            for channel, unit in _NOISE_UNITS.items()
            if channel in noise
        ]
        lines.append(f"  {name:<14}{', '.join(parts)}")
    evidence = report["log_evidence"]
    text = "not computed" if evidence is None else f"{evidence:.2f}"
    lines += ["", f"log-evidence  {text} ({num_draws} draws)"]
    diagnostics = report["diagnostics"]
    lines.append(verdict_line(diagnostics["ok"], diagnostics["reasons"]))
    lines += _further_laws(diagnostics.get("residual", []))
    lines += note_lines(diagnostics.get("notes", []))
    return "\n".join(lines)


def _structure_lines(structures: dict[str, float]) -> list[str]:
    """The most probable structures, and what each constraint has in all of them.

    Of many bodies of which little is known every combination is improbable; what there
    is to know is how probable each constraint is, whatever else there is.
    """
    lines = [f"{'structure':<48}probability"]
    shown = [name for name, p in structures.items() if p >= _LEAST_SHOWN]
    lines += [f"{name:<47} {structures[name]:.3f}" for name in shown[:_MOST_SHOWN]]
    hidden = sum(structures.values()) - sum(structures[x] for x in shown[:_MOST_SHOWN])
    if len(shown) > _MOST_SHOWN:
        others = f"all {len(structures) - _MOST_SHOWN} others"
        lines.append(f"{others:<48}{hidden:.3f}")
        each: dict[str, float] = {}
        for name, probability in structures.items():
            for part in name.split(" + ") if name != "free" else ():
                each[part] = each.get(part, 0.0) + probability
        lines += ["", f"{'constraint, whatever else there is':<48}probability"]
        lines += [
            f"{part:<47} {each[part]:.3f}"
            for part in sorted(each, key=lambda part: -each[part])
            if each[part] >= _LEAST_SHOWN
        ]
    elif len(shown) < len(structures) and hidden > 0:
        lines.append(f"{'all others':<48}{hidden:.1g}")
    return lines


def verdict_line(ok: bool, reasons: list[str]) -> str:
    """Whether diagnostics are ok, and why not."""
    return f"diagnostics   {'ok' if ok else 'NOT OK: ' + '; '.join(reasons)}"


def note_lines(notes: list[str]) -> list[str]:
    """A line of each note."""
    return [f"note          {note}" for note in notes]


def _noise_meaning(freedom: float | None) -> str:
    """What the numbers of the noise are: of Student-t noise they are no sds."""
    if freedom is None:
        return "sd"
    # No Student-t of two degrees of freedom or fewer has one.
    times = np.sqrt(freedom / (freedom - 2.0)) if freedom > 2.0 else np.inf
    return (
        f"scale of Student-t noise of {freedom:g} degrees of freedom, whose sd is "
        f"{times:.2f} times that; of impulses: sd"
    )


def _further_laws(entries: list[dict]) -> list[str]:
    """The best law that each block's model may lack, and whether it does."""
    lines = []
    for entry in entries:
        for best in entry["laws"][:1]:
            law = f"{best['body']}: {best['law'].replace('_', ' ')}"
            factor, least = best["log_bayes_factor"], entry["threshold"]
            if factor <= least:
                lines.append(
                    f"further law   none; likeliest is {law}, log Bayes factor "
                    f"{factor:.1f}, decisive above {least:.1f}"
                )
                continue
            numbers = ", ".join(
                plus_minus({"mean": mean, "sd": sd})
                for mean, sd in zip(best["coefficient"], best["sd"], strict=True)
            )
            numbers = f"{numbers} {best['unit']}".rstrip()
            lines.append(
                f"further law   {law} {numbers}, log Bayes factor {factor:.1f}, "
                f"decisive above {least:.1f}"
            )
    return lines


def _constraint_lines(constraints: list[dict]) -> list[str]:
    """A heading per constraint and a line per quantity."""
    lines = []
    for entry in constraints:
        ends = f"{entry['a']} – {entry['b']}" if "b" in entry else entry["a"]
        lines.append(f"  {entry['type']} ({ends})")
        for key, summary in entry.items():
            if isinstance(summary, dict):
                text = _quantity(summary, _units(entry["type"], key))
                note = _NOTES.get((entry["type"], key), "")
                lines.append(f"    {_TITLES[key]:<20}{text}{note}")
    return lines


def _units(kind: str, key: str) -> list[str]:
    """Units of each number of a quantity."""
    if key == "pose":
        return ["m", "m", "rad"]
    if key in ("axis", "angle"):
        return ["rad"]
    if key in ("viscous", "dry"):
        return [_UNITS[kind][key]] * (2 if kind == "wheel" else 1)
    return ["m", "m"] if key.startswith("anchor") else ["m"]


def _quantity(summary: Summary, units: list[str]) -> str:
    """Every number as mean ± sd and unit, marked where it is only the prior's."""
    columns = {
        key: value if isinstance(value, list) else [value]
        for key, value in summary.items()
        if key != "bodies"
    }
    parts = []
    for place, unit in enumerate(units):
        number = {key: value[place] for key, value in columns.items()}
        if number["mean"] is None:
            parts.append("unlimited")
            continue
        whose = _whose(summary, place).removeprefix("the ")
        mark = "" if number["identified"] else f" ({whose})"
        parts.append(f"{plus_minus(number)} {unit}".rstrip() + mark)
    return ", ".join(parts)


def _whose(summary: Summary, place: int = 0) -> str:
    """What a number is that is not identified."""
    if summary.is_prior[place]:
        return "the prior"
    return "one hypothesis" if not np.ravel(summary["sd"])[place] else "uncertain"


def plus_minus(number: dict) -> str:
    """Mean and sd, with two figures of the sd."""
    if number["mean"] is None or number["sd"] is None:
        return "unlimited"
    if number["sd"] == 0:
        return f"{number['mean']:.4g}"
    digits = max(0, 1 - int(np.floor(np.log10(number["sd"]))))
    digits = min(digits, 6)
    return f"{number['mean']:.{digits}f} ± {number['sd']:.{digits}f}"


def _interval(number: dict) -> str:
    if None in (number["mean"], number["q05"], number["q95"]):
        return "unknown"
    if number["sd"] == 0:
        return f"{number['mean']:.4g}"
    return f"{number['mean']:.4g} ({number['q05']:.4g} to {number['q95']:.4g})"

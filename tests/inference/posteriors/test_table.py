"""The table of structures, where there are few and where there are many."""

import itertools

import pytest

from boomdp_jax.inference.posteriors.table import _structure_lines


def test_a_few_structures_are_all_there_is_to_say():
    lines = _structure_lines({"pin": 0.9, "pin + wheel": 0.0996, "free": 0.0004})
    assert [line.split()[-1] for line in lines] == [
        "probability",
        "0.900",
        "0.100",
        "0.0004",
    ]
    assert lines[-1].startswith("all others ")


def test_of_many_bodies_each_constraint_has_its_probability():
    """Four tables that each have friction with 0.5, 0.6, 0.7 and 0.8, or nothing."""
    probability = {"a": 0.5, "b": 0.6, "c": 0.7, "d": 0.8}
    structures = {}
    for has in itertools.product((False, True), repeat=4):
        value, names = 1.0, []
        for (name, p), is_there in zip(probability.items(), has, strict=True):
            value *= p if is_there else 1.0 - p
            names += [f"{name} friction"] if is_there else []
        structures[" + ".join(names) or "free"] = value
    ordered = dict(sorted(structures.items(), key=lambda item: -item[1]))
    lines = _structure_lines(ordered)
    assert lines[11].startswith("all 6 others ")
    shown = sum(float(line.split()[-1]) for line in lines[1:12])
    assert shown == pytest.approx(1.0, abs=0.01)
    assert lines[13].startswith("constraint, whatever else there is")
    assert lines[14:] == [
        f"{name + ' friction':<47} {p:.3f}"
        for name, p in sorted(probability.items(), key=lambda item: -item[1])
    ]


def test_a_long_name_is_parted_from_its_number():
    name = " + ".join(f"table{i} friction" for i in range(5))
    assert _structure_lines({name: 1.0})[1] == f"{name} 1.000"

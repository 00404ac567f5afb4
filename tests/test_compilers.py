"""The compiler that tests use for its speed agrees with the one that users have."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests import compiled_program


@pytest.mark.slow
def test_what_users_compile_yields_the_same_numbers(tmp_path):
    path = tmp_path / "out.npz"
    subprocess.run(
        [sys.executable, "-m", "tests.compiled_program", str(path)],
        cwd=Path(__file__).parents[1],
        env=os.environ | {"XLA_FLAGS": os.environ.get("USERS_XLA_FLAGS", "")},
        check=True,
    )
    ours = compiled_program.numbers()
    assert np.ptp(ours["states"][:, -1, 0, 0]) > 0.1
    with np.load(path) as users:
        assert sorted(users.files) == sorted(ours)
        for name, value in ours.items():
            np.testing.assert_allclose(users[name], value, rtol=1e-6, atol=1e-9)

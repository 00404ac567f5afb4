"""NPZ archives: what is written is read, and what could do harm is refused."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from boomdp_jax.core.npz_file import read_npz, write_npz


def _array_bytes(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _write_members(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_arrays_come_back_as_they_were(tmp_path: Path):
    arrays = {
        "matrix": np.arange(6.0).reshape(2, 3),
        "columns_first": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "empty": np.zeros((0, 2)),
        "scalar": np.asarray(0.02),
        "text": np.asarray("a line"),
    }
    write_npz(tmp_path / "file", arrays)
    read = read_npz(tmp_path / "file")
    assert read.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype


def test_numpy_reads_what_is_written_and_the_reverse(tmp_path: Path):
    write_npz(tmp_path / "ours.npz", {"x": np.arange(3.0)})
    with np.load(tmp_path / "ours.npz", allow_pickle=False) as content:
        np.testing.assert_array_equal(content["x"], np.arange(3.0))
    np.savez(tmp_path / "theirs.npz", x=np.arange(3.0))
    np.testing.assert_array_equal(
        read_npz(tmp_path / "theirs.npz")["x"], np.arange(3.0)
    )


def test_two_writes_agree_to_the_byte(tmp_path: Path):
    for name in ("first", "second"):
        write_npz(tmp_path / name, {"x": np.arange(3.0)})
    assert (tmp_path / "first").read_bytes() == (tmp_path / "second").read_bytes()


def test_python_objects_are_refused_on_both_ways(tmp_path: Path):
    objects = np.array([{}, []], dtype=object)
    with pytest.raises(ValueError, match="expected numbers or text, got objects"):
        write_npz(tmp_path / "file.npz", {"x": objects})
    assert not (tmp_path / "file.npz").exists()
    np.savez(tmp_path / "file.npz", x=objects)
    with pytest.raises(ValueError, match="x: expected numbers or text, got objects"):
        read_npz(tmp_path / "file.npz")


def test_an_archive_that_unpacks_to_too_much_is_refused_unread(tmp_path: Path):
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, x=np.zeros(2**20))
    assert path.stat().st_size < 2**15
    with pytest.raises(ValueError, match="expected at most 1048576 bytes of arrays"):
        read_npz(path, max_bytes=2**20)


def test_a_header_that_claims_more_than_follows_is_refused(tmp_path: Path):
    honest = _array_bytes(np.zeros(1000))
    lying = honest.replace(b"(1000,)", b"(9999,)")
    path = _write_members(tmp_path / "liar.npz", {"x.npy": lying})
    with pytest.raises(ValueError, match=r"expected 79992 bytes .* got 8000"):
        read_npz(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected an NPZ file"),
        (b"not an archive", "expected an NPZ file"),
        (_array_bytes(np.zeros(3)), "expected an NPZ file"),
    ],
)
def test_what_is_not_an_archive_is_refused(
    tmp_path: Path, content: bytes, message: str
):
    path = tmp_path / "file.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_npz(path)


def test_a_truncated_archive_is_refused(tmp_path: Path):
    path = tmp_path / "file.npz"
    write_npz(path, {"x": np.random.default_rng(0).normal(size=100)})
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(ValueError, match=r"file\.npz: expected an NPZ file"):
        read_npz(path)


def test_damaged_bytes_are_refused(tmp_path: Path):
    path = tmp_path / "file.npz"
    write_npz(path, {"x": np.random.default_rng(0).normal(size=100)})
    content = bytearray(path.read_bytes())
    content[300] ^= 0xFF
    path.write_bytes(bytes(content))
    with pytest.raises(ValueError, match="x: not a readable array"):
        read_npz(path)


def test_entries_that_are_no_arrays_are_refused(tmp_path: Path):
    path = _write_members(tmp_path / "file.npz", {"readme.txt": b"hello"})
    with pytest.raises(ValueError, match=r"arrays only, got an entry 'readme\.txt'"):
        read_npz(path)
    path = _write_members(tmp_path / "file.npz", {"x.npy": b"hello, no header here"})
    with pytest.raises(ValueError, match="x: not a readable array"):
        read_npz(path)


def test_an_archive_of_too_many_arrays_is_refused(tmp_path: Path):
    path = _write_members(tmp_path / "file.npz", {f"{i}.npy": b"" for i in range(1001)})
    with pytest.raises(ValueError, match="at most 1000 arrays, got 1001"):
        read_npz(path)


def test_a_repeated_array_is_refused(tmp_path: Path):
    path = tmp_path / "file.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", _array_bytes(np.zeros(1)))
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive.writestr("x.npy", _array_bytes(np.ones(1)))
    with pytest.raises(ValueError, match="one array 'x', got several"):
        read_npz(path)

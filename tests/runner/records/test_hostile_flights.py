"""Logged flights and trajectories of strangers: one line, in bounded memory and time."""

import zipfile

import numpy as np
import pytest

from crazyarena.crazyswarm_compat.uav_trajectory import Trajectory
from crazyarena.errors import InputError
from crazyarena.runner.records import validate_flights

HEADER = b"\x93NUMPY\x01\x00v\x00"


def archive(file, data, kind=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(file, "w", kind) as packed, packed.open("pos.npy", "w") as entry:
        for part in data:
            entry.write(part)
    return file


def refused(file):
    with pytest.raises(InputError) as error:
        validate_flights.load(file)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_an_archive_that_unpacks_without_end_is_not_unpacked(tmp_path):
    file = archive(tmp_path / "bomb.npz", (bytes(1 << 24) for _ in range(33)))
    assert file.stat().st_size < 1 << 20
    assert "unpacks to 528 MiB; a flight may have 512 MiB" in refused(file)


def test_a_shape_that_is_only_claimed_is_not_made(tmp_path):
    claim = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1152921504606846975,), }"
    file = archive(tmp_path / "claim.npz", [HEADER + claim.ljust(117) + b"\n"])
    assert "not a NumPy archive" in refused(file)


@pytest.mark.parametrize("spoil", ["data", "cut"])
def test_a_spoilt_archive_is_named(tmp_path, spoil):
    file = tmp_path / "spoilt.npz"
    np.savez_compressed(file, pos=np.random.default_rng(1).normal(size=(1000, 3)))
    data = bytearray(file.read_bytes())
    if spoil == "cut":
        del data[len(data) // 2 :]
    else:
        data[60:400] = bytes(340)
    file.write_bytes(data)
    assert "spoilt.npz: not a NumPy archive" in refused(file)


def test_a_trajectory_without_end_is_not_read(tmp_path):
    file = tmp_path / "long.csv"
    with file.open("wb") as stream:
        stream.truncate(1 << 40)
    for path in (file, "/dev/zero"):
        with pytest.raises(InputError, match=r"larger than the 16 MiB|is a folder or a device"):
            Trajectory().loadcsv(path)


def test_a_long_field_of_a_trajectory_is_cut_short(tmp_path):
    file = tmp_path / "field.csv"
    file.write_text("1," + ",".join(["0"] * 30) + "," + "z" * 100_000 + ",1\n" * 2)
    with pytest.raises(InputError) as error:
        Trajectory().loadcsv(file)
    assert len(str(error.value)) < 1000

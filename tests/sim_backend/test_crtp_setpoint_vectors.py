"""Setpoint packets against what the real decoder made of them."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.sim_backend.crtp import setpoints as s
from crazyarena.sim_backend.firmware import layout as la
from tests.recorded import arrays, vector_files

FILES = list(vector_files("packet", "rpyt_packet", "qc_compressed"))
each_file = pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
COLUMNS = {
    "sp_pos": (la.SP_POS, 3),
    "sp_vel": (la.SP_VEL, 3),
    "sp_acc": (la.SP_ACC, 3),
    "sp_att_deg": (la.SP_ATT, 3),
    "sp_rate_dps": (la.SP_RATE, 3),
    "sp_quat_xyzw": (la.SP_QUAT, 4),
    "sp_thrust": (la.SP_THRUST, 1),
    "sp_mode": (la.SP_MODE, 7),
    "sp_velocity_body": (la.SP_BODY, 1),
}


def test_there_are_vectors():
    assert FILES


@each_file
def test_every_packet(path):
    data = arrays(path)
    rows = [
        s.decode_setpoint(packet[:length].tobytes())
        for packet, length in zip(data["packet"], data["packet_len"], strict=True)
    ]
    for name, (offset, count) in COLUMNS.items():
        found = np.array([row[offset : offset + count] for row in rows])
        expected = data[name].reshape(found.shape)
        # Float32 rounding of the firmware only.
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=2e-6, err_msg=name)


@each_file
def test_rpyt_sequence_with_its_thrust_lock(path):
    data = arrays(path)
    decoder = s.RpytDecoder()
    for i, packet in enumerate(data["rpyt_packet"]):
        row = decoder.decode(packet.tobytes(), int(data["rpyt_priority"][i]))
        assert row[la.SP_THRUST] == data["rpyt_thrust"][i], i
        np.testing.assert_array_equal(row[la.SP_ATT : la.SP_ATT + 3], data["rpyt_att_deg"][i])
        np.testing.assert_array_equal(row[la.SP_RATE : la.SP_RATE + 3], data["rpyt_rate_dps"][i])
        np.testing.assert_array_equal(row[la.SP_MODE : la.SP_MODE + 7], data["rpyt_mode"][i])


@each_file
def test_compressed_quaternions(path):
    data = arrays(path)
    codes = [s.compress_quaternion(q) for q in data["qc_quat_xyzw"]]
    np.testing.assert_array_equal(codes, data["qc_compressed"])
    found = [s.decompress_quaternion(int(code)) for code in data["qc_compressed"]]
    np.testing.assert_allclose(found, data["qc_decompressed_xyzw"], atol=1e-6)

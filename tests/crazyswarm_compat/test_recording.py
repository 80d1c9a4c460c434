"""What scripts leave with --record, and what they cost without a display."""

import subprocess
import sys

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.runner.records import export
from crazyarena.runner.records.script_recorder import ScriptRecorder

SCRIPT = """
from pycrazyswarm import Crazyswarm
swarm = Crazyswarm(args="--sim {flags}", crazyflies_yaml='''
crazyflies:
- {{id: 1, channel: 100, initialPosition: [1.0, 0.0, 0.0], type: default}}
- {{id: 7, channel: 100, initialPosition: [0.0, 1.0, 0.0], type: default}}
''')
swarm.allcfs.takeoff(1.0, 2.0)
swarm.timeHelper.sleep(3.0)
{more}
"""


def script(tmp_path, flags, more=""):
    (tmp_path / "script.py").write_text(SCRIPT.format(flags=flags, more=more))
    code = "from crazyarena.__main__ import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, "run", "script.py"],
        cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip


@pytest.mark.parametrize("failing", [False, True])
def test_a_script_leaves_a_recording_a_vehicle_and_a_picture(tmp_path, failing):
    more = "raise ValueError('lost')" if failing else ""
    done = script(tmp_path, "--vis null --record kept", more)
    assert (done.returncode != 0) == failing, done.stderr
    kept = tmp_path / "kept"
    assert sorted(file.name for file in kept.iterdir()) == ["cf1.mcap", "cf7.mcap", "flight.png"]
    assert (kept / "flight.png").read_bytes()[:4] == b"\x89PNG"
    flight = export.read(kept / "cf7.mcap")
    assert flight.complete
    rows, columns = flight.tables["state"], flight.columns["state"]
    first = columns.index("position_0")
    assert rows[0, first : first + 3] == pytest.approx([0.0, 1.0, 0.0], abs=1e-6)
    assert rows[-1, first + 2] == pytest.approx(1.0, abs=0.05)
    assert np.diff(rows[:, columns.index("time")]) == pytest.approx(0.1)
    again = script(tmp_path, "--vis null --record kept")
    assert again.returncode != 0
    assert "holds an older run" in again.stderr


def test_a_viewer_without_a_display_loads_nothing(tmp_path, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND"):
        monkeypatch.delenv(name, raising=False)
    told = "import sys; print('drawn', 'matplotlib' in sys.modules)"
    done = script(tmp_path, "--vis mpl", told)
    assert "drawn False" in done.stdout, done.stderr


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--record"):
        ScriptRecorder(tmp_path / "file" / "kept", [1], None)

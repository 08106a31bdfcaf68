"""The commands of a skin at a port, end to end: emulate, record, play back, evaluate."""

import signal
import time
from contextlib import contextmanager

import pytest

pytest.importorskip("termios", reason="pseudo-terminals need a POSIX system")

from skin.device.files import read_recording
from skin.record.session import read_session

SMALL = ["layout=grid", "layout.rows=2", "layout.columns=2", "simulator=naive"]
PATIENCE = 300  # s: machines are busy at times


@pytest.fixture
def emulated(begin, tmp_path):
    """Return a function that runs the emulator and gives device.port, its lines and the process."""

    @contextmanager
    def emulated(*overrides):
        with begin(tmp_path, "emulate", *SMALL, *overrides) as process:
            lines = process.lines()
            yield next(lines), lines, process

    return emulated


@pytest.mark.slow("starts an emulator and waits for a signal")
def test_ctrl_c_ends_the_emulator_well(emulated, tmp_path):
    link = tmp_path / "skin"
    with emulated(f"link={link}") as (port, lines, process):
        assert port == str(link)
        assert "device.scale=0.0390625" in next(lines)
        process.send_signal(signal.SIGINT)
        assert process.wait() == 0
    assert not link.is_symlink()


@pytest.mark.slow("records twice from an emulator")
def test_a_session_that_was_killed_goes_on_and_is_played_back(run, begin, emulated, tmp_path):
    path = tmp_path / "s"
    with emulated("emulate.speed=5", "touch.window=3") as (port, _, _):
        settings = ["device.labels=announced", "device.scale=0.0390625", f"device.port={port}"]
        command = ["record.py", *SMALL, f"out={path}", *settings]
        with begin(tmp_path, *command) as killed:
            deadline = time.monotonic() + PATIENCE
            while not path.exists() or not list(path.glob("gesture_*")):
                assert time.monotonic() < deadline
                time.sleep(0.05)
            killed.kill()
        before = {file.name: file.read_bytes() for file in path.iterdir() if file.name[0] != "."}
        done = len(read_session(path).gestures)
        assert done >= 1
        resumed = run(tmp_path, *command, f"device.gestures={done + 2}", store=False)
    assert resumed.returncode == 0, resumed.stderr
    assert all((path / name).read_bytes() == content for name, content in before.items())
    stored = read_recording(tmp_path / "s.parquet")
    assert len(stored) == done + 2
    assert stored.touches.readings.shape[1:] == (30, 4)
    assert (stored.touches.readings.flatten(1).amax(1) > 0.3).all()
    again = run(tmp_path, "record.py", *SMALL, f"out={path}", "record.finish=true", store=False)
    assert f"{done + 2} gestures" in again.stdout

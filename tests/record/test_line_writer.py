"""Lines stay whole on a full disk, and one writer keeps others out."""

import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("fcntl", reason="file limits need a POSIX system")

from skin.device.resampling import Frame
from skin.errors import InputError
from skin.record.recorder import LineWriter, SessionLog, locked
from skin.record.session import decode_event, encode_event, read_session
from skin.wire.channels import UnitConversion
from skin.wire.segmentation import RecordedGesture

ABOUT = {"positions": [[0.0, 0.0, 0.0]] * 2, "unit": "adc"}


@contextmanager
def room(size):
    """Let files grow to ``size`` bytes: a write beyond takes a part, the next one fails."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def frame(number):
    return Frame(number, number / 100, 0.0, np.array([500.0, 512.0]), np.array([True, True]))


def test_lines_end_alike_on_windows(tmp_path, monkeypatch):
    path, flags, usual = tmp_path / "session.csv", [], os.open
    path.touch()
    monkeypatch.setattr(os, "O_BINARY", 1 << 15, raising=False)
    monkeypatch.setattr(os, "open", lambda path, flag: flags.append(flag) or usual(path, flag))
    LineWriter(path).close()
    assert flags[0] & os.O_BINARY


def recorded(log, number):
    """Record a gesture of twenty frames."""
    gesture = RecordedGesture(number, {"big": 1}, number / 2, 0)
    log.begin(gesture, frame(50 * number))
    for one in range(50 * number, 50 * number + 20):
        log.frame(frame(one))
    log.end(gesture)


def fill(path, done):
    """Record gestures, and note those that are whole."""
    log = SessionLog(path, ABOUT, 2)
    try:
        log.conversion(conversion())
        for number in range(10):
            recorded(log, number)
            done.add(number)
    finally:
        log.close()


def conversion():
    return UnitConversion(np.ones(2), np.zeros(2), np.zeros(2, dtype=bool))


def test_a_short_write_is_finished(tmp_path, monkeypatch):
    path = tmp_path / "x"
    path.touch()
    write = os.write
    monkeypatch.setattr(os, "write", lambda file, data: write(file, data[:3]))
    lines = LineWriter(path)
    lines.add("0123456789")
    lines.close()
    assert path.read_text() == "0123456789\n"


def test_a_line_that_does_not_fit_leaves_nothing(tmp_path):
    path = tmp_path / "x"
    path.touch()
    lines = LineWriter(path)
    with room(1005):
        for _ in range(125):
            lines.add("0123456")
        with pytest.raises(InputError, match=r"cannot write .*/x: File too large; its content is kept"):
            lines.add("0123456789")
    lines.add("more room")
    lines.close()
    assert path.read_bytes() == b"0123456\n" * 125 + b"more room\n"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_device_is_said(tmp_path):
    (tmp_path / "x.csv").symlink_to("/dev/full")
    with pytest.raises(InputError, match="No space left on device"):
        LineWriter(tmp_path / "x.csv").add("1")


@pytest.mark.parametrize("size", [0, 100, *range(250, 4000, 150)])
def test_a_session_on_a_full_disk_is_whole_and_goes_on(tmp_path, size):
    path, done = tmp_path / "x.csv", set()
    with room(size), pytest.raises(InputError, match="cannot write"):
        fill(path, done)
    assert not list(tmp_path.glob("*.part"))
    if path.exists():
        assert path.read_bytes().endswith(b"\n")
        assert set(read_session(path).gestures) == done
    log = SessionLog(path, ABOUT, 2)
    assert log.done == done
    log.conversion(conversion())
    recorded(log, 10)
    log.close()
    stored = read_session(path)
    assert (set(stored.gestures), stored.warnings) == (done | {10}, [])


def test_a_folder_that_may_not_be_written_is_said(tmp_path):
    folder = tmp_path / "ro"
    folder.mkdir()
    folder.chmod(0o555)
    tmp_path.chmod(0o755)
    # As root nothing is forbidden, so another user tries; by then everything is imported.
    code = (
        "import os, sys; from pathlib import Path\n"
        "from skin.record.recorder import locked\n"
        "from skin.record.recorder import SessionLog\n"
        "os.geteuid() or os.seteuid(65534)\n"
        "about = {'positions': [[0, 0, 0]], 'unit': 'N'}\n"
        "for attempt in (lambda p: locked(p).__enter__(), lambda p: SessionLog(p, about, 1)):\n"
        "    try: attempt(Path(sys.argv[1]))\n"
        "    except ValueError as error: print(error)\n"
    )
    path = f"/proc/self/cwd/{folder.name}/x.csv"  # the folders above may be another user's
    command = [sys.executable, "-c", code, path]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.count("Permission denied: make it writable, or choose another place") == 2
    assert not list(folder.iterdir())


@pytest.mark.parametrize("text", ["a,b\n1,2\n3,4", "precious", "time,seq,raw_00\n1,2,3\n4,5"])
def test_a_file_that_is_no_session_is_left_alone(tmp_path, text):
    path = tmp_path / "x.csv"
    path.write_text(text)
    with pytest.raises(InputError, match="not a session"):
        SessionLog(path, ABOUT, 2)
    assert path.read_text() == text


@pytest.mark.parametrize("beginning", ["", "time,s", "time,seq,raw_00,raw_01\n"])
def test_half_a_header_is_begun_anew(tmp_path, beginning):
    path = tmp_path / "x.csv"
    path.write_text(beginning)
    log = SessionLog(path, ABOUT, 2)
    log.conversion(conversion())
    recorded(log, 0)
    log.close()
    assert set(read_session(path).gestures) == {0}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            {"window": 20},
            "of 30 frames at 10 Hz, the configuration has 20 at 10 Hz: give touch.window=3 touch.rate=10",
        ),
        (
            {"rate": 12.5},
            r"at 10 Hz, the configuration has 30 at 12\.5 Hz: give touch\.window=3 touch\.rate=10",
        ),
        ({"unit": "N"}, "recorded in adc, the device sends N: give another out="),
        ({"id": "arm-R"}, "recorded from the device arm-L, this is arm-R: give another out="),
        ({"id": None}, r"recorded from the device arm-L, this is unknown \(header missing"),
        ({"bits": 12}, "recorded with 10 bits, the device sends 12: give another out="),
    ],
)
def test_a_session_goes_on_as_it_was_begun(tmp_path, change, reason):
    about = ABOUT | {"window": 30, "rate": 10.0, "id": "arm-L", "bits": 10}
    SessionLog(tmp_path / "x.csv", about, 2).close()
    log = SessionLog(tmp_path / "x.csv", about, 2)
    log.conversion(conversion())
    recorded(log, 0)
    log.close()
    with pytest.raises(InputError, match=reason):
        SessionLog(tmp_path / "x.csv", about | change, 2)


def test_one_writer_keeps_others_out_until_it_ends(tmp_path):
    path, link = tmp_path / "x.csv", tmp_path / "y.csv"
    with locked(path):
        for name in (path, tmp_path / "." / "x.csv", tmp_path / "none" / ".." / "x.csv"):
            (tmp_path / "none").mkdir(exist_ok=True)
            with pytest.raises(InputError, match="being recorded by another process"), locked(name):
                pass
        with locked(link):
            pass
    link.symlink_to(path)
    with locked(link), pytest.raises(InputError, match="another process"), locked(path):
        pass
    with locked(path):
        pass


def test_kill_9_lets_go_of_the_lock(tmp_path):
    code = (
        "import sys; from pathlib import Path; from skin.record.recorder import locked\n"
        "with locked(Path(sys.argv[1])):\n"
        "    print('locked', flush=True)\n"
        "    sys.stdin.read()\n"
    )
    path = tmp_path / "x.csv"
    command = [sys.executable, "-c", code, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"locked\n"
        with pytest.raises(InputError, match="another process"), locked(path):
            pass
        holder.send_signal(signal.SIGKILL)
        holder.wait(60)
        with locked(path):
            pass


def test_an_event_with_another_digit_is_told_from_the_right_one():
    line, token = encode_event("begin", number=3, labels={"big": 1}, time=0.5)
    assert decode_event(line) == ({"event": "begin", "number": 3, "labels": {"big": 1}, "time": 0.5}, token)
    with pytest.raises(ValueError, match="checksum"):
        decode_event(line.replace('"big": 1', '"big": 0'))


def test_a_hard_link_is_the_same_file(tmp_path):
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    with locked(first):
        log = SessionLog(first, ABOUT, 2)
        log.conversion(UnitConversion(np.ones(2), np.zeros(2), np.zeros(2, bool)))
        log.frame(frame(0))
        os.link(first, second)
        os.link(tmp_path / "first.csv.json", tmp_path / "second.csv.json")
        with (
            pytest.raises(InputError, match=r"second\.csv is being recorded by another process"),
            locked(second),
        ):
            pass
        with pytest.raises(InputError, match=r"second\.csv is being recorded by another process"):
            SessionLog(second, ABOUT, 2)
        log.frame(frame(1))
        log.close()
    with locked(second):
        SessionLog(second, ABOUT, 2).close()
    assert read_session(first).frames == 2


def test_a_device_is_no_session(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(InputError, match="is not a regular file"):
        SessionLog(tmp_path / "pipe.csv", ABOUT, 2)

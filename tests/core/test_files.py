"""A full disk costs one sentence: nothing is half-written, and what was there before stays."""

import json
import os
import resource
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from skin.calibration.bench import BenchSession
from skin.calibration.bench import write_bench_session as write_session
from skin.core.files import json_line, json_text, write
from skin.core.messages import to_input_error
from skin.device import calibration
from skin.device.files import write_recording as write_recording
from skin.device.touches import Recording
from skin.errors import InputError
from skin.evaluation.report import write_probabilities
from skin.mechanics import array_cache
from skin.plot import figures
from skin.runs.configuration import Tracking
from skin.runs.store import Store
from skin.touch.labels import TOUCH

GARBAGE = {
    "text": b"no database at all, but some words that are longer than a header of SQLite needs to be",
    "bytes": bytes(range(256)) * 20,
    "header": b"SQLite format 3\0" + bytes(2000),
}


@contextmanager
def full(size=50):
    """Refuse every write beyond ``size`` bytes of a file, as a full disk does, by the system's own limit."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def recorded(path, device):
    write_recording(Recording(device.touches("test"), TOUCH, (0.1, 0.1), (0.01, 0.01)), path)


def sessions(path, device):
    write_session(BenchSession(np.arange(99.0), np.ones((99, 3)), "N"), path)


def drawn(path, device):
    figures.save_figure(figures.traces({"a": torch.ones(9, 3)}, 10.0), path)


def calibrated(path, device):
    calibration.write_calibration(calibration.Calibration({"gain": 99 * [1.0]}), path)


WRITERS = {"x.parquet": recorded, "x.csv": recorded, "session.csv": sessions, "session.parquet": sessions}
WRITERS |= {"figure.png": drawn, "gains.yaml": calibrated}
WRITERS |= {"page.md": lambda path, device: write(200 * "a", path)}
WRITERS |= {"chances.csv": lambda path, device: write_probabilities(torch.ones(9, 4), TOUCH, None, path)}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_what_was_there(name, tmp_path, made_up_device):
    path = tmp_path / "folder" / name
    path.parent.mkdir()
    path.write_text("before")
    with full(), pytest.raises(InputError, match=rf"^cannot write .*{name}: File too large: .* as in"):
        WRITERS[name](path, made_up_device)
    assert path.read_text() == "before"
    assert list(path.parent.iterdir()) == [path]
    WRITERS[name](path, made_up_device)
    assert path.read_bytes()[:6] != b"before"


@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_that_cannot_be_is_refused(name, tmp_path, made_up_device):
    (tmp_path / "file").write_text("before")
    with pytest.raises(InputError, match=rf"^cannot write .*{name}: "):
        WRITERS[name](tmp_path / "file" / name, made_up_device)
    assert (tmp_path / "file").read_text() == "before"


def test_numbers_in_json_are_finite_without_digits_of_the_processor():
    content = {"a": [0.1 + 0.2, (1 / 3 * 1e-9,)], "b": {"count": 1234567, "known": True, "none": None}}
    assert json.loads(json_text(content)) == content | {"a": [0.3, [3.33333e-10]]}
    assert json_text({"a": 0.032572243846157964}) == json_text({"a": 0.03257224384616024})
    content = {"a": [float("inf"), -1e300, 1], "b": {"c": (float("nan"), "NaN")}}
    assert json_line(content) == '{"a": [null, -1e+300, 1], "b": {"c": [null, "NaN"]}}'
    assert json.loads(json_text({"a": float("inf")})) == {"a": None}


def test_a_cache_that_cannot_be_kept_costs_a_warning(tmp_path):
    path = tmp_path / "x.npz"
    with full(), pytest.warns(RuntimeWarning, match="cannot be kept"):
        found = array_cache.kept(path, "key", {"a": (99,)}, lambda: {"a": np.ones(99)})
    assert found["a"].sum() == 99
    assert not list(tmp_path.iterdir())


@pytest.mark.slow("imports MLflow anew on a full disk")
def test_a_database_on_a_full_disk_is_told_of_and_goes_on(tmp_path):
    settings = Tracking(f"sqlite:///{tmp_path}/m.db", f"{tmp_path}/a", "skin", True, None)
    with full(200_000), pytest.raises(InputError, match=r"^cannot (use the runs in sqlite|write)"):
        Store.open(settings)
    assert not (tmp_path / "m.db").exists()
    store = Store.open(settings)
    with full(), pytest.raises(Exception, match="disk") as caught:  # MLflow's own
        store.client.create_run(store.experiment)
    assert "the database of runs failed" in str(to_input_error(caught.value))
    with store.run("later", {}):
        pass


@pytest.mark.parametrize("content", GARBAGE)
def test_garbage_is_no_database(content, tmp_path):
    path = tmp_path / "m.db"
    path.write_bytes(GARBAGE[content])
    with pytest.raises(InputError, match=r"^cannot use the runs in .*m\.db: .*tracking\.uri="):
        Store.open(Tracking(f"sqlite:///{path}", f"{tmp_path}/a", "skin", True, None))
    assert path.read_bytes() == GARBAGE[content]


def test_errors_of_ours_keep_their_traceback():
    assert to_input_error(FileNotFoundError(2, "No such file", "x")) is None
    assert to_input_error(ZeroDivisionError()) is None
    assert "x.csv: Read-only" in str(to_input_error(OSError(30, "Read-only file system", "x.csv")))


def test_a_file_has_reached_the_disk_before_it_takes_its_place(tmp_path, monkeypatch):
    path, synced = tmp_path / "x.txt", []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append((os.fstat(file).st_size, path.exists())))
    write("0123456789", path)
    assert synced == [(10, False)]

"""Readers of public data sets, on files in their exact format, and functions of one's own."""

import re
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from skin.core.files import ROOT
from skin.device.conversion import convert_files, eflesh, epi, read_by_function
from skin.device.files import read_recording, write_recording
from skin.device.formats import read_format
from skin.errors import InputError

REAL = ROOT.parent / "shared" / "real"
OWN = """
import numpy as np
from skin.device.conversion import build_recording


def read(path, scale: float = 1.0):
    return build_recording(scale * np.load(path), 20.0, labels={"press": [1, 0]})


def nothing(path):
    return path
"""


def test_the_reader_of_the_page_has_the_captures_of_cost(tmp_path):
    """Channels 62 to 64 hold gesture, variant and subject."""
    random, captures = np.random.default_rng(0), {}
    lines = ["subject, variant, gesture, frame, " + ", ".join(f"ch{number}" for number in range(1, 65))]
    for subject, variant, gesture in product((1, 21), (1, 2, 3), (1, 2, 14)):
        counts = random.integers(0, 1024, (int(random.integers(10, 40)), 64))
        counts[:, 61:] = gesture, variant, subject
        captures[gesture, variant, subject] = counts
        numbered = enumerate(counts.tolist(), start=1)
        lines += [f"{subject},{variant},{gesture},{n}," + ",".join(map(str, row)) for n, row in numbered]
    (tmp_path / "CoST.csv").write_text("\n".join(lines))
    names = {}
    exec(re.search(r"```py\n(.*?)```", (ROOT / "docs" / "data.md").read_text(), re.S)[1], names)
    recording = names["read"](tmp_path / "CoST.csv", frames=17)
    assert recording.task.names == tuple(
        f"{a}_{b}" for a in ("grab", "hit") for b in ("gentle", "normal", "rough")
    )
    assert len(recording) == 12
    subjects = recording.parameters["group_subject"].int().tolist()
    given = recording.touches.readings.numpy(), recording.touches.labels, subjects
    for readings, labels, number in zip(*given, strict=True):
        key = tuple((readings[0, 61:] / 0.0097752).round().astype(int).tolist())
        assert int(labels.argmax()) == 3 * (key[0] - 1) + key[1] - 1
        assert recording.metadata["groups"]["subject"][number] == str(key[2])
        first, last = 0.0097752 * captures[key][[0, -1]]
        assert np.allclose(readings[[0, -1]], [first, last], atol=1e-4)


def test_epi_has_a_touch_in_each_row(tmp_path):
    values = np.arange(11 * 1200).reshape(11, 12, 100)
    lines = "\n".join(",".join(map(str, row.ravel())) for row in values)
    (tmp_path / "training_data_x.csv").write_text(lines)
    (tmp_path / "training_data_y.csv").write_text("\n".join(map(str, range(10, -1, -1))))
    recording = epi(tmp_path)
    assert torch.allclose(recording.touches.readings[3], torch.tensor(0.1 * values[3].T).float())
    assert recording.task.names == ("big", "dynamic", "press")
    assert recording.touches.labels[[10, 3]].tolist() == [[1, 0, 1], [1, 0, 0]]  # hold and slap
    assert recording.touches.labels[7].isnan().tolist() == [False, True, True]  # pick
    assert recording.metadata["classes"][:2] == ["hold", "rub"]
    assert recording.parameters["class"].tolist() == list(range(10, -1, -1))
    with pytest.raises(InputError, match="has no touches of Epi"):
        epi(tmp_path / "none")


def write_eflesh(folder: Path, states: list[list[float]]) -> None:
    """Write two sessions as eFlesh has them: two files without a header, joined by row."""
    for number in range(2):
        (session := folder / f"2025040{number}_probe").mkdir()
        fields = [[1e9 + row, *(10 * row + np.arange(15))] for row in range(len(states))]
        for name, rows in (("sensor_post_baselines", fields), ("states", states)):
            (session / f"{name}.csv").write_text("\n".join(",".join(map(str, row)) for row in rows))


def test_eflesh_has_forces_in_every_other_row(tmp_path):
    write_eflesh(tmp_path, [[1e9 + row, 315, -100, 288, -1 if row % 2 else 300.0 * row] for row in range(10)])
    recording = eflesh(tmp_path)
    assert recording.touches.readings.shape == (20, 5, 15)
    assert torch.allclose(recording.touches.readings[3, 2], 0.1 * (30 + torch.arange(15.0)))
    assert not recording.touches.readings[:, [0, 1, 3, 4]].any()
    assert torch.equal(recording.touches.positions[0], recording.touches.positions[2])
    force, label = recording.parameters["force"][:10], recording.touches.labels[:10, 0]
    assert force[4] == pytest.approx(1.2 * 9.80665)
    assert label.nan_to_num(-1).tolist() == [0, -1, 0, -1, 1, -1, 1, -1, 1, -1]  # 10 N are 1020 g
    assert force.isnan().tolist() == label.isnan().tolist()
    assert recording.metadata["groups"] == {"session": ["20250400_probe", "20250401_probe"]}
    assert recording.parameters["group_session"].tolist() == [0] * 10 + [1] * 10
    stored = read_recording(write_recording(recording, tmp_path / "x.parquet"))
    assert torch.equal(stored.touches.labels.isnan(), recording.touches.labels.isnan())
    for name, values in recording.parameters.items():
        assert torch.equal(stored.parameters[name].nan_to_num(-1), values.nan_to_num(-1)), name


def test_eflesh_places_begin_at_zero(tmp_path):
    with pytest.raises(InputError, match=r"has no file \*/sensor_post_baselines.csv"):
        eflesh(tmp_path)
    write_eflesh(tmp_path, [[row, 274 + 10 * row, -115 + 20 * row, 142] for row in range(3)])
    recording = eflesh(tmp_path)
    assert recording.parameters["x"][:3].tolist() == pytest.approx([0, 0.01, 0.02])
    assert recording.parameters["y"][:3].tolist() == pytest.approx([0, 0.02, 0.04])
    assert (recording.task.names, recording.size) == (("right", "low"), (0.03, 0.03))
    next(tmp_path.glob("*/states.csv")).write_text("1,2,3,4\n")
    with pytest.raises(InputError, match=r"states\.csv needs as many rows"):
        eflesh(tmp_path)


@pytest.mark.slow("converts recordings that are large")
@pytest.mark.skipif(not REAL.is_dir(), reason="needs the real recordings")
def test_real_recordings_are_converted():
    pytest.importorskip("openpyxl")
    recordings = [eflesh(REAL / "eflesh" / name) for name in ("normal_force", "spatial_resolution")]
    recordings.append(convert_files(read_format("sdu"), REAL / "sdu_fsi"))
    shapes = [tuple(recording.touches.readings.shape) for recording in recordings]
    assert shapes == [(10800, 5, 15), (9610, 5, 15), (15376, 5, 4)]
    known = [int((~recording.touches.labels[:, 0].isnan()).sum()) for recording in recordings]
    assert known == [5580, 9610, 15376]
    assert all(recording.touches.valid.all() for recording in recordings)


def test_a_function_of_ones_own_reads_what_it_likes(tmp_path, monkeypatch):
    (tmp_path / "my_reader.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    np.save(tmp_path / "x.npy", np.ones((2, 5, 3), np.float32))
    recording = read_by_function("my_reader.read", tmp_path / "x.npy", {"scale": 0.5})
    assert (recording.touches.readings == 0.5).all()
    assert recording.task.names == ("press",)
    for reader, options, message in (
        ("my_reader.reed", {}, "reader=my_reader.reed cannot be imported"),
        ("my_reader.read", {"scal": 1}, "options has no setting scal: did you mean scale"),
        ("my_reader.read", {"scale": "big"}, "options.scale=big must be a valid number"),
        ("my_reader.nothing", {}, "must return a Recording, got PosixPath"),
    ):
        with pytest.raises(InputError, match=message):
            read_by_function(reader, tmp_path / "x.npy", options)

"""Readers of public data sets, on files in their exact format, and functions of one's own."""

import csv
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from skin.core.files import ROOT
from skin.device.conversion import convert_files, read_by_function
from skin.device.files import read_recording, write_recording
from skin.device.formats import read_format
from skin.device.readers import GESTURES, VARIANTS, cost, eflesh, epi
from skin.errors import InputError

REAL = ROOT.parent / "shared" / "real"
SUBJECTS = (1, 2, 3, 5, 8, 13, 21, 31)
HEADER = "subject, variant, gesture, frame, " + ", ".join(f"ch{number}" for number in range(1, 65))


@pytest.fixture(scope="module")
def corpus(tmp_path_factory) -> Path:
    """Return a file in the format of CoST.csv; channels 62 to 64 hold gesture, variant and subject."""
    random, lines = np.random.default_rng(0), [HEADER]
    for subject, variant, gesture in product(SUBJECTS, (1, 2, 3), range(1, 15)):
        counts = random.integers(0, 1024, (int(random.integers(10, 40)), 64))
        counts[:, 61:] = 10 * gesture, 100 * variant, 20 * subject
        head = f"{subject},{variant},{gesture}"
        lines += [f"{head},{n}," + ",".join(map(str, row)) for n, row in enumerate(counts.tolist(), start=1)]
    path = tmp_path_factory.mktemp("corpus") / "CoST.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_every_capture_is_resampled_as_numpy_does(corpus):
    captures: list[list[list[int]]] = []
    with corpus.open() as file:
        for row in list(csv.reader(file))[1:]:
            numbers = [int(text) for text in row]
            if numbers[3] == 1:
                captures.append([])
            captures[-1].append(numbers)
    recording = cost(corpus, window=17)
    assert len(recording) == len(captures)
    for readings, capture in zip(recording.touches.readings.numpy(), map(np.array, captures), strict=True):
        old, new = np.linspace(0, 1, len(capture)), np.linspace(0, 1, 17)
        expected = np.stack([np.interp(new, old, column) for column in capture[:, 4:].T], axis=1)
        assert np.allclose(readings, 0.0097752 * expected, atol=1e-4)
    frames = np.median([135 * 16 / (len(capture) - 1) for capture in captures])
    assert recording.touches.rate == pytest.approx(frames)


@pytest.mark.parametrize(
    ("gestures", "variants"), [(GESTURES, False), (("grab", "hit"), True), (("tap", "massage"), False)]
)
def test_classes_and_subjects_are_those_of_the_file(corpus, gestures, variants):
    recording = cost(corpus, gestures, variants)
    names = [f"{name}_{how}" for name in gestures for how in VARIANTS] if variants else list(gestures)
    assert (list(recording.task.names), recording.task.kind) == (names, "exclusive")
    hidden = (recording.touches.readings[:, 0, 61:] / 0.0097752 / torch.tensor([10, 100, 20])).round().int()
    subjects = recording.metadata["groups"]["subject"]
    assert sorted(map(int, subjects)) == list(SUBJECTS)
    for (gesture, variant, subject), label, number in zip(
        hidden.tolist(),
        recording.touches.labels.argmax(1).tolist(),
        recording.parameters["group_subject"].int().tolist(),
        strict=True,
    ):
        words = [GESTURES[gesture - 1], *([VARIANTS[variant - 1]] if variants else [])]
        assert "_".join(words) == names[label]
        assert int(subjects[number]) == subject


def test_taxels_are_channels(corpus):
    whole = cost(corpus, pitch=0.02)
    assert whole.size == pytest.approx((0.16, 0.16))
    part = cost(corpus, taxels=[64, 1, 8, 57], pitch=0.02)
    assert torch.equal(part.touches.readings, whole.touches.readings[:, :, [0, 7, 56, 63]])
    corners = [[0.01, 0.01, 0], [0.15, 0.01, 0], [0.01, 0.15, 0], [0.15, 0.15, 0]]
    assert np.allclose(part.touches.positions, corners)


def changed(line: int, column: int, value: str):
    """Return a change of one number in a file's lines, counted from 1 with the header."""

    def change(lines: list[str]) -> list[str]:
        row = lines[line - 1].split(",")
        row[column] = value
        return [*lines[: line - 1], ",".join(row), *lines[line:]]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: [], "No columns to parse"),
        (changed(1, 2, " Gesture"), "has no column gesture, which CoST.csv of https://doi"),
        (changed(1, 67, " ch65"), "has no column ch64"),
        (changed(9, 67, "5,5"), "Expected 68 fields in line 9, saw 69"),
        (changed(9, 10, "x"), "column ch7 has 'x' in row 8, no number"),
    ],
)
def test_an_altered_file_is_refused(corpus, tmp_path, change, message):
    path = tmp_path / "CoST.csv"
    path.write_text("\n".join(change(corpus.read_text().splitlines()[:60])))
    with pytest.raises(InputError, match=message) as refused:
        cost(path)
    assert "\n" not in str(refused.value)
    with pytest.raises(InputError, match=r"CoST.csv is at https://doi"):
        cost(tmp_path / "none.csv")


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


OWN = """
import numpy as np
from skin.device.conversion import build_recording


def read(path, scale: float = 1.0):
    return build_recording(scale * np.load(path), 20.0, labels={"press": [1, 0]})


def nothing(path):
    return path
"""


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

"""Foreign files become recordings: mappings, readers of public data sets, functions of one's own."""

import re
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
import yaml

from skin import InputError, read_recording
from skin.body.base import Sensors
from skin.core.files import CONF, ROOT
from skin.device.conversion import convert_files, eflesh, epi, read_by_function
from skin.device.files import write_recording
from skin.device.formats import read_format

PLAIN = {
    "files": "*.csv",
    "time": {"column": "t", "unit": "ms"},
    "channels": {"columns": "s*", "unit": "g"},
    "segments": {"by": "file", "frames": 4},
}
ROWS = [(100 * n, n, 10 * n) for n in range(4)]
LABELS = ("none", "press", "press", "press")
LINES = (f"{t},{a},{b},{label},anna\n" for (t, a, b), label in zip(ROWS, LABELS, strict=True))
TABLE = "".join(["t,s0,s1,label,person\n", *LINES])
WINDOWS = PLAIN | {"channels": {"columns": "s*", "unit": "N"}, "segments": {"by": "windows", "frames": 20}}
PRESS = {"press": {"column": "label", "values": {"press": 1, "none": 0}}}
HEADLESS = {"table": {"header": None}, "time": {"column": 0, "unit": "ms"}}
HEADLESS |= {"channels": {"columns": [1, 2], "unit": "g"}}
DATES = {"time": {"column": "t"}, "table": {"parse_dates": ["t"]}}
LOCAL = {"table": {"parse_dates": ["t"], "date_format": "%d.%m.%Y %H:%M:%S.%f %z"}}


def convert(folder: Path, settings: dict, **files: str | bytes):
    for name, text in (files or {"a.csv": TABLE}).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    (folder / "map.yaml").write_text(yaml.safe_dump(settings))
    return convert_files(read_format(str(folder / "map.yaml")), folder)


def test_sdu_is_a_spreadsheet_whose_places_are_groups(tmp_path):
    pytest.importorskip("openpyxl")
    rows = [(2 * (n % 3), 0, 0.7, 4.0, 1 + n, 2 + n, 0.9 * n, None) for n in range(9)]
    table = pd.DataFrame(rows, columns=["X", "Y", "Tl", "Tr", "Pl", "Pr", "F", "Depth"])
    path = tmp_path / "2D_6060_learning_data.xlsx"
    table.to_excel(path, index=False)
    recording = convert_files(read_format("sdu"), path)
    assert recording.touches.readings[4, 2].tolist() == pytest.approx([5, 6, 0.07, 0.4])
    assert recording.touches.labels[:, 0].tolist() == [0] * 5 + [1] * 4
    assert recording.metadata["groups"] == {"place": ["0 0", "2 0", "4 0"]}
    assert recording.parameters["x"][:3].tolist() == pytest.approx([0, 0.002, 0.004])


def test_a_folder_has_contacts_and_persons(tmp_path):
    files = {}
    for person, (number, gesture) in product(("anna", "ben"), enumerate(("press", "tap", "pat"))):
        rows = (f"{n / 20:.2f},{500 + 100 * (40 <= n < 60)},{400 + number},{gesture}" for n in range(120))
        files[f"{person}/{number}.csv"] = "\n".join(["time,s0,s1,label", *rows])
    convert(tmp_path, yaml.safe_load((CONF / "mapping" / "folder.yaml").read_text()), **files)
    recording = convert_files(read_format("folder"), tmp_path)
    assert (recording.touches.readings.shape, recording.touches.rate) == ((6, 30, 2), 10)
    peak = recording.touches.readings[0, :, 0]
    assert peak.nonzero().flatten().tolist() == list(range(5, 15))  # 20 rows at 20 Hz, 10 at 10 Hz
    assert peak.max() == pytest.approx(2.0)
    assert recording.touches.labels[:, 0].nan_to_num(-1).tolist() == [1, 0, -1] * 2
    assert recording.metadata["groups"] == {"person": ["anna", "ben"]}


def test_a_tap_between_two_frames_keeps_its_peak(tmp_path):
    times = np.arange(20_000)  # ms
    taps = np.where(times % 7, 5.0 * (times % 2000 // 40 == 13), np.nan)
    settings = WINDOWS | {"rate": 10.0, "targets": {"force": {"column": "s0", "unit": "N"}}}
    text = pd.DataFrame({"t": times, "s0": taps}).to_csv(index=False)
    found = convert(tmp_path, settings, **{"a.csv": text})
    assert found.touches.valid.all()
    assert found.parameters["force"].tolist() == found.touches.readings.amax((1, 2)).tolist() == [5.0] * 10


def test_files_of_different_rates_need_one(tmp_path):
    files = {f"{s}.csv": "t,s0\n" + "".join(f"{s * n},1\n" for n in range(20)) for s in (10, 95, 100)}
    with pytest.raises(InputError, match="has files of 10 to 100 Hz: give rate, Hz"):
        convert(tmp_path, WINDOWS, **files)
    (tmp_path / "10.csv").unlink()
    assert 10 < convert_files(read_format(str(tmp_path / "map.yaml")), tmp_path).touches.rate < 10.6


@pytest.mark.parametrize("rate", [5.0, 10.0, 20.0])
def test_nothing_is_known_of_a_pause(tmp_path, rate):
    times = np.r_[0:10_000:100, 20_000:30_100:100]  # ms
    text = pd.DataFrame({"t": times, "s0": 3 * (np.abs(times - 15_000) < 5550)}).to_csv(index=False)
    settings = WINDOWS | {"rate": rate, "segments": {"by": "windows", "frames": int(rate)}}
    touches = convert(tmp_path, settings, **{"a.csv": text}).touches
    assert len(touches) == 20
    assert touches.valid[:, :-1].all()
    assert touches.readings[9, -2] == touches.readings[10, 0] == 3


@pytest.mark.parametrize(("baseline", "step"), [(None, 100), (2, 100), ("idle", 100), (2, 50)])
def test_a_baseline_is_subtracted(tmp_path, baseline, step):
    """Of twice as many rows, two are one frame."""
    text = "t,s0\n" + "".join(f"{step * n},{value}\n" for n, value in enumerate([7, 7, 9, 7]))
    given = {"baseline": baseline, "channels": {"columns": ["s0"], "unit": "N"}, "rate": 10.0}
    recording = convert(tmp_path, PLAIN | given, **{"a.csv": text})
    expected = [7, 7, 9, 7] if baseline is None else [0, 0, 2, 0] if step == 100 else [0, 2, 0, 0]
    assert recording.touches.readings.flatten().tolist() == pytest.approx(expected)


def test_a_missing_value_is_invalid(tmp_path):
    text = "t,s0,s1\n0,1,2\n100,,3\n200,-999,4\n"
    recording = convert(tmp_path, PLAIN | {"table": {"na_values": [-999]}}, **{"a.csv": text})
    assert recording.touches.valid[0, :3, 0].tolist() == [True, False, False]
    assert recording.touches.readings[0, 1:3, 0].tolist() == [0, 0]
    with pytest.raises(InputError, match="column s0 has 'inf' in row 2"):
        convert(tmp_path, PLAIN, **{"a.csv": text.replace("100,,", "100,inf,")})


def test_positions_are_of_the_mapping_or_of_the_layout(tmp_path):
    stated = PLAIN | {"positions": [[0.01, 0.02], [0.03, 0.02]], "size": [0.05, 0.04]}
    recording = convert(tmp_path, stated)
    assert np.allclose(recording.touches.positions, [[0.01, 0.02, 0], [0.03, 0.02, 0]])
    assert recording.size == (0.05, 0.04)
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(PLAIN | {"positions": "layout"}))
    sensors = Sensors(np.array([[0.1, 0.1, 0.01], [0.2, 0.1, 0.01]]), (0.02, 0.02))
    recording = convert_files(read_format(str(tmp_path / "map.yaml")), tmp_path, sensors, (0.3, 0.2))
    assert np.allclose(recording.touches.positions, sensors.positions)
    assert (recording.size, recording.footprint) == ((0.3, 0.2), (0.02, 0.02))
    with pytest.raises(InputError, match="needs a skin: give layout=file"):
        convert_files(read_format(str(tmp_path / "map.yaml")), tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"files": "*.txt"}, r"has no file \*\.txt: give the folder of the recordings, path=FOLDER"),
        ({"channels": {"columns": ["s0", "s7"], "unit": "N"}}, r"has no column s7, which channels.columns"),
        ({"channels": {"columns": ["s0"]}}, "channels needs unit, got columns"),
        ({"channels": {"columns": ["s0"], "unit": "V"}}, "unit=V is no force .*: add channels.scale"),
        ({"channels": {"columns": ["label"], "unit": "N"}}, "column label has 'none' in row 1, no number"),
        ({"time": {"column": "t"}, "rate": 10.0}, r"is the time in ms\? Give time.unit: ms"),
        ({"time": None}, "add time, as in time: .* or rate, Hz"),
        ({"targets": {"force": {"column": "s0", "unit": "mm"}}}, "force with unit mm: its units are N"),
        ({"labels": PRESS}, "rows 1 to 4: label press contradicts itself, with none and press"),
        ({"labels": {"press": {"column": "label", "values": {"tap": 1}}}}, "press is unknown in all touches"),
        ({"labels": {"press": {"column": "label", "values": {True: 1}}}}, "quote what YAML reads as true"),
        ({"classes": {"column": "person"}}, "fewer than two of the classes anna"),
        ({"groups": ["label"]}, "each touch needs one label, got none and press"),
        ({"groups": {"both": ["s0", "s1"]}}, r"has no column s\*, which channels.columns names"),
        ({"reader": "os.system"}, "map.yaml has no setting reader"),
        ({"table": {"skip": 1}}, "cannot read .*unexpected keyword argument 'skip'; table has options"),
        ({"time": {"column": "person", "unit": "s"}}, "'anna' in row 1, no number: .*table.parse_dates"),
        ({"fields": "(?P<person>[0-9]+)"}, "a.csv does not fit the regular expression"),
        ({"segments": {"by": "contact", "threshold": 100.0}}, "has no touch: lower segments.threshold"),
        ({"positions": [[0, 0]], "size": [0.1, 0.1]}, "readings of 2 sensors, positions are 1"),
        ("t,s0,s1\n0,1,1\n200,1,1\n100,1,1\n", "time goes backwards at row 3, from 0.200000 to 0.100000 s"),
        ("t,s0,s1\n0,1,1\n0,1,1\n", "its times do not differ"),
        ("t,s0,s1\nms,N,N\n0,1,1\n", "column t has 'ms' in row 1, no number: .* correct .* table.skiprows"),
        ("t,s0,s0 \n0,1,1\n", "several columns are called s0"),
    ],
)
def test_a_wrong_mapping_or_file_is_one_sentence(tmp_path, changes, message):
    text, changes = (changes, {}) if isinstance(changes, str) else (TABLE, changes)
    settings = {name: value for name, value in (PLAIN | changes).items() if value is not None}
    with pytest.raises(InputError, match=message) as refused:
        convert(tmp_path, settings, **{"a.csv": text})
    assert "\n" not in str(refused.value)


def lines(*rows: str, first: str = "t,s0,s1", name: str = "{},{},{}") -> str:
    return "\n".join([*rows, first, *(name.format(*row) for row in ROWS)])


@pytest.mark.parametrize(
    ("changes", "files"),
    [
        ({}, {"a.csv": lines()}),
        ({"table": {"encoding": "utf-16"}}, {"a.csv": lines().encode("utf-16")}),
        ({"table": {"skiprows": 2}}, {"a.csv": lines("maker: X", "t0; 1, 2, 3")}),
        ({"table": {"sep": "[;|]"}}, {"a.csv": lines(first="t;s0|s1", name="{};{}|{}")}),
        ({"table": {"skipfooter": 1}}, {"a.csv": lines() + "\nend"}),
        (HEADLESS, {"a.csv": "\n".join(f"{t},{a},{b}" for t, a, b in ROWS)}),
        (DATES, {"a.csv": lines(name="2025-11-28T06:00:00.{:03d}+01:00,{},{}")}),
        (DATES | LOCAL, {"a.csv": lines(name="28.11.2025 06:00:00.{:03d} +0100,{},{}")}),
        ({"time": {"column": "t", "unit": "ns"}}, {"a.csv": lines(name="17643{:03d}000000,{},{}")}),
    ],
)
def test_the_same_readings_are_read_from_every_plain_file(tmp_path, changes, files):
    touches = convert(tmp_path, PLAIN | changes, **files).touches
    expected = 9.80665e-3 * np.array([[a, b] for _, a, b in ROWS])
    assert np.allclose(touches.readings[0], expected)
    assert touches.rate == pytest.approx(10)
    assert touches.labels is None


def test_classes_have_the_order_of_the_mapping(tmp_path):
    files = {f"{n}.csv": TABLE.replace("none", kind).replace("press", kind) for n, kind in enumerate("abc")}
    recording = convert(tmp_path, PLAIN | {"classes": {"column": "label", "names": ["b", "a"]}}, **files)
    assert list(recording.task.names) == ["b", "a"]
    assert recording.touches.labels.nan_to_num(-1).tolist() == [[0, 1], [1, 0], [-1, -1]]


@pytest.mark.parametrize("gaps", [True, False], ids=["at the peaks", "anywhere"])
def test_presses_over_the_range_do_not_vanish(tmp_path, gaps):
    """Three presses of which the sensor shows OL beyond 8, against three gaps at rest."""
    values = np.maximum(0, 10 * np.sin(np.arange(120) / 6)).round(1)
    texts = np.where(values > 8, "OL", values) if gaps else np.where(np.arange(120) % 37 == 30, "OL", values)
    text = "t,s0,s1\n" + "".join(f"{100 * n},{value},1\n" for n, value in enumerate(texts))
    settings = PLAIN | {"table": {"na_values": ["OL"]}, "segments": {"by": "file", "frames": 120}}
    if not gaps:
        assert not convert(tmp_path, settings, **{"a.csv": text}).touches.valid.all()
        return
    with pytest.raises(InputError, match=r"column s0 has no value .* a press over the range"):
        convert(tmp_path, settings, **{"a.csv": text})


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
    classes = product(("grab", "hit"), ("gentle", "normal", "rough"))
    assert recording.task.names == tuple(map("_".join, classes))
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
        ("my_reader.nothing", {}, "must return a Recording, got PosixPath"),
    ):
        with pytest.raises(InputError, match=message):
            read_by_function(reader, tmp_path / "x.npy", options)

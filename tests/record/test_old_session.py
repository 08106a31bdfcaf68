"""Sessions of earlier versions become folders; a damaged line costs its gesture and changes no other."""

import json
import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin.errors import InputError
from skin.record.recorder import convert_old_session
from skin.record.session import read_session
from tests.damage import DAMAGED_FILES, damaged, opened

OLD = Path(__file__).with_name("old_session.csv")
"""Written by an earlier version: two baselines, a gesture broken off by a restart, ill channels."""


@pytest.fixture
def old(tmp_path):
    shutil.copy(OLD, tmp_path / "x.csv")
    shutil.copy(OLD.with_name("old_session.csv.json"), tmp_path / "x.csv.json")
    return tmp_path / "x.csv"


def windows(folder):
    """Return labels, baseline and window of each gesture."""
    gestures = read_session(folder).gestures
    return {
        number: (
            gesture.labels,
            conversion.zero.tolist(),
            gesture.lost,
            *map(np.ndarray.tolist, gesture.resampled[:3]),
        )
        for number, (gesture, conversion) in gestures.items()
    }


def frames(folder):
    rows = [row for table in read_session(folder).tables for row in table.to_pylist()]
    return sorted(rows, key=lambda row: row["time"])


def summed(content):
    """Return an event as a line with its checksum."""
    text = "# " + json.dumps({name: value for name, value in content.items() if name != "sum"})
    return f'{text[:-1]}, "sum": "{zlib.crc32(text.encode()):08x}"}}'


def test_it_becomes_a_folder(old, tmp_path):
    assert convert_old_session(old, tmp_path / "s") == f"{tmp_path}/s: 6 gestures"
    found = windows(tmp_path / "s")
    assert sorted(found) == list(range(6))
    for number, (labels, zero, lost, values, valid, saturated) in found.items():
        first = 20 * (number % 3)
        ill = [[True, True]] * 3 + [[True, number % 3 > 0]] * 2
        assert (labels, lost) == ({"big": number % 2, "dangerous": 1}, 0)
        assert zero == ([512.0, 500.0] if number < 3 else [300.0, 200.0])
        assert values == [[first + 2 * n + 1, 512.0 * ill[n][1]] for n in range(5)]
        assert valid == ill
        assert not np.any(saturated)
    lines = [line.split(",") for line in old.read_text().splitlines()[1:] if line[0] != "#"]
    assert [[row["seq"], row["raw_00"]] for row in frames(tmp_path / "s")] == [
        [int(line[1]), float(line[2])] for line in lines
    ]
    assert [row["time"] for row in frames(tmp_path / "s")] == pytest.approx(
        [float(line[0]) for line in lines], abs=2e-3
    )
    metadata = json.loads(old.with_name("x.csv.json").read_text())
    stored = read_session(tmp_path / "s").metadata
    assert {**stored, "format": 2} == {name: value for name, value in metadata.items() if name != "sum"}


def test_contacts_and_limits_come_along(old, tmp_path):
    lines = old.read_text().splitlines()
    place = next(n for n, line in enumerate(lines) if '"begin", "number": 1' in line)
    contacts = {"most": 2, "rows": [[3, 1, 0.1, 0.2, 0.3, 0.4, 0.5]]}
    lines[place] = summed(json.loads(lines[place][1:]) | {"saturated": [0], "contacts": contacts})
    old.write_text("\n".join(lines) + "\n")
    convert_old_session(old, tmp_path / "s")
    gesture, _ = read_session(tmp_path / "s").gestures[1]
    assert gesture.contacts[3, 1].tolist() == contacts["rows"][0][2:]
    assert np.isfinite(gesture.contacts).sum() == 5
    assert gesture.resampled.saturated.tolist() == [[True, False]] * 5


def test_any_damaged_line_costs_a_gesture_at_most_but_a_baseline_three(old, tmp_path):
    lines, whole = old.read_bytes().splitlines(), None
    for place in [None, *range(1, len(lines))]:
        damage = lines[place][:5] + b"\xff" + lines[place][6:] if place else b""
        spoilt = lines if place is None else [*lines[:place], damage, *lines[place + 1 :]]
        old.write_bytes(b"\n".join(spoilt) + b"\n")
        said = convert_old_session(old, tmp_path / "s")
        found = windows(tmp_path / "s")
        whole = whole or found
        left = sorted(set(whole) - set(found))
        assert {number: found[number] for number in found} == {number: whole[number] for number in found}
        assert len(left) <= (3 if place and b'"meaning", "scale"' in lines[place] else 1)
        assert not left or f"without {', '.join(map(str, left))}, which" in said or len(left) == 1
        shutil.rmtree(tmp_path / "s")


def test_random_damage_changes_no_gesture(old, tmp_path):
    convert_old_session(old, tmp_path / "whole")
    whole, content = windows(tmp_path / "whole"), old.read_bytes()

    @DAMAGED_FILES
    @given(draw=st.data())
    def damage(draw):
        old.write_bytes(draw.draw(damaged(content)))
        shutil.rmtree(tmp_path / "s", ignore_errors=True)
        if opened(lambda: convert_old_session(old, tmp_path / "s")):
            found = windows(tmp_path / "s")
            assert found == {number: whole[number] for number in found}

    damage()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize(
    "about", [None, "", "[]", '{"format": 1, "sum": ""}', '{"format": 2, "sum": "", "positions": 3}']
)
def test_what_is_none_is_refused(old, tmp_path, about):
    beside = old.with_name("x.csv.json")
    beside.unlink() if about is None else beside.write_text(about)
    with pytest.raises(InputError, match=r"cannot convert \S+x\.csv"):
        convert_old_session(old, tmp_path / "s")
    assert (
        sorted(path.name for path in tmp_path.iterdir()) == ["x.csv", "x.csv.json"][: 1 + (about is not None)]
    )


def test_an_existing_folder_is_left_alone(old, tmp_path):
    (tmp_path / "s").mkdir()
    with pytest.raises(InputError, match="exists: give another out="):
        convert_old_session(old, tmp_path / "s")

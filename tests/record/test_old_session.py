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
from skin.record.session import convert_old_session, read_session
from tests.damage import DAMAGED_FILES, damaged, opened
from tests.record.test_session import everything, frames_of

OLD = Path(__file__).with_name("old_session.csv")
"""Written by an earlier version: two baselines, a gesture broken off by a restart, ill channels."""


@pytest.fixture
def old(tmp_path):
    shutil.copy(OLD, tmp_path / "x.csv")
    shutil.copy(OLD.with_name("old_session.csv.json"), tmp_path / "x.csv.json")
    return tmp_path / "x.csv"


def test_it_becomes_a_folder(old, tmp_path):
    assert convert_old_session(old, tmp_path / "s") == f"{tmp_path}/s: 6 gestures"
    stored = read_session(tmp_path / "s")
    assert sorted(stored.gestures) == list(range(6))
    for number, (gesture, conversion) in stored.gestures.items():
        first, window = 20 * (number % 3), gesture.resampled
        ill = [[True, True]] * 3 + [[True, number % 3 > 0]] * 2
        assert (gesture.labels, gesture.lost) == ({"big": number % 2, "dangerous": 1}, 0)
        assert conversion.zero.tolist() == ([512.0, 500.0] if number < 3 else [300.0, 200.0])
        assert window.values.tolist() == [[first + 2 * n + 1, 512.0 * ill[n][1]] for n in range(5)]
        assert window.valid.tolist() == ill
        assert not window.saturated.any()
    lines = [line.split(",") for line in old.read_text().splitlines()[1:] if line[0] != "#"]
    rows = frames_of(tmp_path / "s")
    assert [[row["seq"], row["raw_00"]] for row in rows] == [[int(line[1]), float(line[2])] for line in lines]
    assert [row["time"] for row in rows] == pytest.approx([float(line[0]) for line in lines], abs=2e-3)
    metadata = json.loads(old.with_name("x.csv.json").read_text())
    del metadata["sum"]
    assert stored.metadata | {"format": 2} == metadata
    with pytest.raises(InputError, match="exists: give another out="):
        convert_old_session(old, tmp_path / "s")


def test_contacts_and_limits_come_along(old, tmp_path):
    lines = old.read_text().splitlines()
    position = next(n for n, line in enumerate(lines) if '"begin", "number": 1' in line)
    contacts = {"most": 2, "rows": [[3, 1, 0.1, 0.2, 0.3, 0.4, 0.5]]}
    content = json.loads(lines[position][1:]) | {"saturated": [0], "contacts": contacts}
    del content["sum"]
    text = "# " + json.dumps(content)
    lines[position] = f'{text[:-1]}, "sum": "{zlib.crc32(text.encode()):08x}"}}'
    old.write_text("\n".join(lines) + "\n")
    convert_old_session(old, tmp_path / "s")
    gesture, _ = read_session(tmp_path / "s").gestures[1]
    assert gesture.contacts[3, 1].tolist() == contacts["rows"][0][2:]
    assert np.isfinite(gesture.contacts).sum() == 5
    assert gesture.resampled.saturated.tolist() == [[True, False]] * 5


@pytest.mark.slow("converts 160 damaged sessions, each written as files")
def test_damage_costs_gestures_and_changes_none(old, tmp_path):
    """A line costs a gesture at most, that of a baseline three."""
    convert_old_session(old, tmp_path / "whole")
    whole, content = everything(read_session(tmp_path / "whole").gestures), old.read_bytes()

    def converted(spoilt):
        old.write_bytes(spoilt)
        shutil.rmtree(tmp_path / "s", ignore_errors=True)
        text = opened(lambda: convert_old_session(old, tmp_path / "s"))
        found = everything(read_session(tmp_path / "s").gestures) if text else {}
        assert found == {number: whole[number] for number in found}
        return text, sorted(set(whole) - set(found))

    lines = content.splitlines()
    for position in [n for n, line in enumerate(lines) if n % 30 == 1 or (n > 1 and line[:1] == b"#")]:
        damage = lines[position][:5] + b"\xff" + lines[position][6:]
        text, left = converted(b"\n".join([*lines[:position], damage, *lines[position + 1 :], b""]))
        assert len(left) <= (3 if b'"meaning", "scale"' in lines[position] else 1)
        assert f"without {', '.join(map(str, left))}, which" in text or len(left) <= 1

    @DAMAGED_FILES
    @given(draw=st.data())
    def damage_at_random(draw):
        converted(draw.draw(damaged(content)))

    damage_at_random()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize(
    "about", ["", "[]", '{"format": 1, "sum": ""}', '{"format": 2, "sum": "", "positions": 3}']
)
def test_what_is_none_is_refused(old, tmp_path, about):
    old.with_name("x.csv.json").write_text(about)
    with pytest.raises(InputError, match=r"cannot convert \S+x\.csv"):
        convert_old_session(old, tmp_path / "s")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.csv", "x.csv.json"]

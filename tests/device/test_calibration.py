"""Calibration files: what is written is read, and what a person may write."""

import os
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from skin.device.calibration import Calibration, read_calibration, write_calibration
from skin.errors import InputError
from tests.damage import DAMAGED_FILES, damaged, mutated, opened

KNOWN = {"gain": [1.1, None, 0.9], "offset": [0.1, 2.5, -0.3]}
KNOWN |= {"clip": [None, 7.5, None], "noise": [1e-05, 0.2, 0.0]}
RANGES = {"gain": [0.9, 1.1], "dead": [0, 1]}
WHOLE = Calibration(KNOWN, {"dead": [], "stuck": [1]}, RANGES, 0.0123456789012345, 511.5, {"unit": "adc"})


def test_a_file_keeps_everything(tmp_path):
    wired = replace(WHOLE, polarity=(1, -1, -1), channels=(2, 0, 1))
    for kept in (WHOLE, wired):
        path = write_calibration(kept, tmp_path / "folder" / "mine.yaml")
        assert read_calibration(path) == kept
        assert ("polarity" in path.read_text()) == (kept is wired)
    assert list(path.parent.iterdir()) == [path]


def test_a_person_may_write_little(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("format: 1\ncount: 4\nsensors: {noise: 1e-2}\nranges: {dead: [0, 3]}\n")
    values = read_calibration(path).values()
    assert (values["noise"].tolist(), values["gain"].tolist()) == ([0.01] * 4, [1.0] * 4)
    assert np.isinf(values["clip"]).all()


def test_channels_inwards_have_what_is_known_of_them(tmp_path):
    """Of sites with three axes; broken channels along the surface are left out."""
    tables = {1: [[0, 1], [0, 2]], 5: [[0, 1], [0, 3]]}
    gains = {"gain": [1.0, 1.0, 0.8, 1.0, 1.0, 1.2]}
    wiring = {"polarity": [1, 1, -1] * 2, "channels": [*range(6)], "tables": tables}
    three = Calibration(gains, {"dead": [0, 5]}, {"dead": [0, 6]}, **wiring)
    read = read_calibration(write_calibration(three, tmp_path / "three.yaml"), inwards=True)
    wiring = {"polarity": (-1, -1), "tables": {1: [[0, 1], [0, 3]]}}
    assert read == Calibration({"gain": [0.8, 1.2]}, {"dead": [1]}, **wiring)


def test_true_readings_behind_raw_ones():
    """What is unknown of a sensor is the median of the others."""
    values = WHOLE.values()
    np.testing.assert_allclose(values["gain"], [1.1, 1.0, 0.9])
    np.testing.assert_array_equal(values["clip"], [7.5, 7.5, 7.5])
    assert (values["dead"].tolist(), values["level"][1]) == ([False, True, False], 2.5)
    sent = np.array([2.0, 1.0, 4.0]) * [1.1, 1, 0.9] + [0.1, 0, -0.3]
    np.testing.assert_allclose(WHOLE.corrected(sent / WHOLE.scale + 511.5), [2.0, np.nan, 4.0])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("format: 2", "is no calibration"),
        ("a: [", "cannot read"),
        ("format: 1\ncount: 2\nsensors: {gian: 1}", "sensors takes gain, .* got gian"),
        ("format: 1\ncount: 2\nsensors: {gain: [1]\n  ,noise: [1, 2]}", "as many numbers"),
        ("format: 1\ncount: 2\nsensors: {gain: [1, x]}", "must be a valid number, not text"),
        ("format: 1\ncount: 2\nsensors: {noise: -1}", "noise must be numbers from 0 to"),
        ("format: 1\ncount: 2\nsensors: {gain: 1}\nranges: {gain: [2, 1]}", r"must be a range \[minimum, m"),
        ("format: 1\ncount: 2\nsensors: {gain: 1}\nbroken: {dead: [2]}", "take sensors 0 to 1"),
    ],
)
def test_what_cannot_be_used_is_refused(tmp_path, text, reason):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=reason):
        read_calibration(path)


def test_what_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    for name in ("none.yaml", "pipe.yaml"):
        with pytest.raises(InputError, match=r"no calibration .*skin calibrate"):
            read_calibration(tmp_path / name)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write_calibration(WHOLE, tmp_path_factory.mktemp("calibration") / "mine.yaml")


@DAMAGED_FILES
@given(data=st.data())
def test_damage_never_passes_for_constants(written, data):
    path = written.with_name("damaged.yaml")
    path.write_bytes(data.draw(damaged(written.read_bytes())))
    assert opened(lambda: read_calibration(path)) in (None, WHOLE)


@DAMAGED_FILES
@given(data=st.data())
def test_a_file_by_hand_works_or_is_refused(written, data):
    path = written.with_name("by_hand.yaml")
    content = {name: value for name, value in yaml.safe_load(written.read_text()).items() if name != "sha256"}
    path.write_text(yaml.safe_dump(data.draw(mutated(content)), allow_unicode=True))
    calibration = opened(lambda: read_calibration(path))
    if calibration is not None:
        calibration.values()
        calibration.draw((len(calibration),), np.random.default_rng(0))
        write_calibration(calibration, path.with_name("again.yaml"))


def test_who_changes_a_file_by_hand_is_told_what_to_do(written, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(written.read_text().replace("511.5", "512.5"))
    with pytest.raises(InputError, match="remove its line sha256 if you changed it by hand"):
        read_calibration(path)
    path.write_text(re.sub("sha256.*\n", "", path.read_text()))
    assert read_calibration(path).zero == 512.5


@pytest.mark.parametrize("count", ["1000000000", "0", "-1", "true", "2.0", "'3'", "1e9"])
def test_no_memory_is_taken_for_a_count_that_no_skin_has(tmp_path, count):
    path = tmp_path / "mine.yaml"
    path.write_text(f"format: 1\ncount: {count}\nsensors: {{gain: 1}}\n")
    with pytest.raises(InputError, match="count must be a whole number from 1 to 10000"):
        read_calibration(path)

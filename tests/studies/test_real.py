"""Real recordings: samples in their form, the choice of an estimator, and the threshold of the alarm."""

import csv

import numpy as np
import pandas as pd
import pytest

from experiments.studies import real
from skin.core.files import ROOT
from skin.errors import InputError

REAL = ROOT.parent / "shared/real"


def write_session(folder, seed, presses=60):
    """Write a session in the form of eFlesh: 15 smooth functions of a force up to 20 N, and a gauge."""
    draw = np.random.default_rng(seed)
    force = 10 - 10 * np.cos(np.arange(presses) * 2 * np.pi / 6)
    time = 1.7e9 + 0.1 * np.arange(presses)
    field = np.outer(force, np.linspace(1, 3, 15)) + np.outer(np.sqrt(force), np.linspace(-5, 5, 15))
    field += draw.normal(0, 0.5, field.shape)
    gauge = np.where(np.arange(presses) % 2, -1, force / 9.80665e-3)
    folder.mkdir(parents=True)
    np.savetxt(
        folder / "sensor_post_baselines.csv", np.column_stack([time, field]), delimiter=",", fmt="%.6f"
    )
    states = np.column_stack([time, np.zeros((presses, 3)), gauge])
    np.savetxt(folder / "states.csv", states, delimiter=",", fmt="%.6f")


def write_pad(folder, side=6):
    """Write a spreadsheet in the form of SDU: two pressures that tell where a press was, and how hard."""
    draw = np.random.default_rng(0)
    x, y, force = (
        part.ravel() for part in np.meshgrid(*[10.0 * np.arange(side)] * 2, np.linspace(0.5, 7.5, 8))
    )
    left, right = force * (1.2 - x / 100), force * (0.7 + x / 100)
    late = 2 + y / 20 + draw.normal(0, 0.05, len(x))
    folder.mkdir()
    columns = {"X": x, "Y": y, "Tl": late, "Tr": late + 0.5, "Pl": left, "Pr": right, "F": force}
    pd.DataFrame(columns).to_excel(folder / "2D_6060_learning_data.xlsx", index=False)


def run(folder, *words):
    """Run the study, and return the lines of its file by metric and what the interval is over."""
    real.main([f"data={folder}", f"out={folder}/out", *words])
    with (folder / "out/real.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_force_is_learnt_from_sessions_and_tested_on_another(tmp_path):
    for seed in range(3):
        write_session(tmp_path / real.FORCE / f"session_{seed}", seed)
    (line,) = run(tmp_path, "rows=eflesh force")[:1]
    assert line["split"] == "sessions 1+2 -> 3"
    assert (line["training"], line["test"]) == ("60", "30")
    assert float(line["low"]) <= float(line["value"]) <= float(line["high"]) < 1.0


def test_the_choice_and_the_prediction_do_not_depend_on_the_targets_of_the_test():
    draw = np.random.default_rng(0)
    x = draw.normal(size=(90, 3))
    presses = real.Presses({"readings": x}, x[:, :1] ** 2, np.repeat([0, 1, 2], 30), np.arange(90))
    spoilt = real.Presses(presses.inputs, presses.targets.copy(), presses.session, presses.place)
    spoilt.targets[60:] = 1e6
    row, settings = real.ROWS[3], real.RealSettings("")
    lines = [next(real.run_sessions(row, each, settings, {0, 1}, 2)) for each in (presses, spoilt)]
    assert lines[0]["estimator"] == lines[1]["estimator"]
    assert lines[1]["value"] > 1e5


@pytest.mark.slow
def test_an_alarm_on_unseen_places_has_intervals_over_presses_and_places(tmp_path):
    write_pad(tmp_path / "sdu_fsi")
    lines = run(tmp_path, "rows=sdu alarm")
    assert {line["over"] for line in lines} == {"presses", "places"}
    assert all(line["split"] == real.UNSEEN for line in lines)
    assert all(float(line["low"]) <= float(line["value"]) <= float(line["high"]) for line in lines)
    # Seven calibrating places cannot bound misses by one in a hundred: every press alarms.
    bounds = {line["metric"]: float(line["value"]) for line in lines}
    assert bounds["misses, risk 1 %"] == 0
    assert bounds["false alarms, risk 1 %"] == 100


def test_the_threshold_bounds_misses_at_new_places():
    """The mean over 400 draws of 60 calibrating places is at most the risk, and not far below."""
    draw, misses = np.random.default_rng(0), []
    for _ in range(400):
        offset = np.repeat(draw.normal(0, 0.5, 120), 8)
        scores, places = 5 + offset + draw.normal(0, 0.5, 960), np.repeat(np.arange(120), 8)
        limit = real.risk_threshold(scores[:480], np.ones(480, bool), places[:480], 0.1)
        misses.append((scores[480:] < limit).mean())
    assert 0.08 < np.mean(misses) < 0.1 + 2 * np.std(misses) / 20


def test_only_sweeps_of_a_force_have_a_history(tmp_path):
    for seed in range(3):
        write_session(tmp_path / real.FORCE / f"session_{seed}", seed)
    presses = real.read_presses(real.ROWS[3], tmp_path, 1.0, 0)
    history = presses.inputs["history"]
    assert history.shape == (90, 30)
    first = np.flatnonzero(np.diff(presses.session, prepend=-1))
    assert len(first) == 3
    assert not history[first, 15:].any()
    assert history[first + 1, 15:].any(axis=1).all()
    write_pad(tmp_path / "sdu_fsi")
    assert "history" not in real.read_presses(real.ROWS[6], tmp_path, 1.0, 0).inputs


def test_intervals_count_units_not_presses():
    squares, units = np.repeat(np.random.default_rng(0).exponential(1, 20), 50), np.repeat(np.arange(20), 50)
    wide, narrow = (real.interval(squares, over, 0) for over in (units, np.arange(1000)))
    assert wide[1] - wide[0] > 3 * (narrow[1] - narrow[0])


@pytest.mark.parametrize(
    "words", ["data={}", "data={} rows=nothing", "data={} share=0", "data={} speed=1", "share=1"]
)
def test_wrong_settings_are_one_sentence(tmp_path, words):
    with pytest.raises(InputError) as error:
        real.main(words.format(tmp_path).split(" "))
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="the recordings are not part of the repository")
def test_a_tenth_of_the_real_recordings(tmp_path):
    """With 360 presses of two sessions the force of the third errs by 0.55 N, of 34 N at most."""
    real.main([f"data={REAL}", f"out={tmp_path}", "share=0.1", "rows=eflesh force"])
    with (tmp_path / "real.csv").open() as file:
        assert all(float(line["value"]) < 1.0 for line in csv.DictReader(file))

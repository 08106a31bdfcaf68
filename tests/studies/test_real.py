"""Real recordings: samples in their form, the choice of an estimator, and the threshold of the alarm."""

import csv

import numpy as np
import pandas as pd
import pytest

from experiments.studies import real, real_barometers, real_epi, real_presses, real_rows
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


@pytest.mark.slow("chooses among all estimators twice")
def test_a_force_is_learnt_from_sessions_and_tested_on_another(tmp_path):
    for seed in range(3):
        write_session(tmp_path / real_presses.FORCE / f"session_{seed}", seed, 30)
    (line,) = run(tmp_path, "rows=eflesh force")[:1]
    assert line["split"] == "sessions 1+2 -> 3"
    assert (line["training"], line["test"]) == ("30", "15")
    assert float(line["low"]) <= float(line["value"]) <= float(line["high"]) < 1.0


def test_the_choice_and_the_prediction_do_not_depend_on_the_targets_of_the_test():
    draw = np.random.default_rng(0)
    x = draw.normal(size=(45, 3))
    presses = real_rows.Presses({"readings": x}, x[:, :1] ** 2, np.repeat([0, 1, 2], 15), np.arange(45))
    spoilt = real_rows.Presses(presses.inputs, presses.targets.copy(), presses.session, presses.place)
    spoilt.targets[30:] = 1e6
    row, settings = real.ROWS[3], real_rows.RealSettings("")
    lines = [next(real_presses.run_sessions(row, each, settings, {0, 1}, 2)) for each in (presses, spoilt)]
    assert lines[0]["estimator"] == lines[1]["estimator"]
    assert lines[1]["value"] > 1e5


@pytest.mark.slow("fits hundreds of presses")
def test_an_alarm_on_unseen_places_has_intervals_over_presses_and_places(tmp_path):
    write_pad(tmp_path / "sdu_fsi")
    lines = run(tmp_path, "rows=sdu alarm")
    assert {line["over"] for line in lines} == {"presses", "places"}
    assert all(line["split"] == real_presses.UNSEEN for line in lines)
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
        limit = real_presses.risk_threshold(scores[:480], np.ones(480, bool), places[:480], 0.1)
        misses.append((scores[480:] < limit).mean())
    assert 0.08 < np.mean(misses) < 0.1 + 2 * np.std(misses) / 20


def test_only_sweeps_of_a_force_have_a_history(tmp_path):
    for seed in range(3):
        write_session(tmp_path / real_presses.FORCE / f"session_{seed}", seed)
    settings = real_rows.RealSettings("")
    presses = real_presses.read_presses(real.ROWS[3], tmp_path / real_presses.FORCE, settings)
    history = presses.inputs["history"]
    assert history.shape == (90, 30)
    first = np.flatnonzero(np.diff(presses.session, prepend=-1))
    assert len(first) == 3
    assert not history[first, 15:].any()
    assert history[first + 1, 15:].any(axis=1).all()
    write_pad(tmp_path / "sdu_fsi")
    pad = real_presses.read_presses(real.ROWS[6], tmp_path / real_presses.PAD, settings)
    assert "history" not in pad.inputs


def test_intervals_count_units_not_presses():
    squares, units = np.repeat(np.random.default_rng(0).exponential(1, 20), 50), np.repeat(np.arange(20), 50)
    wide, narrow = (real_rows.interval(squares, over, 0) for over in (units, np.arange(1000)))
    assert wide[1] - wide[0] > 3 * (narrow[1] - narrow[0])


@pytest.mark.parametrize(
    "words", ["data={}", "data={} rows=nothing", "data={} share=0", "data={} speed=1", "share=1"]
)
def test_wrong_settings_are_one_sentence(tmp_path, words):
    with pytest.raises(InputError) as error:
        real.main(words.format(tmp_path).split(" "))
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow("fits a tenth of the real recordings")
@pytest.mark.skipif(not REAL.is_dir(), reason="the recordings are not part of the repository")
def test_a_tenth_of_the_real_recordings(tmp_path):
    """With 360 presses of two sessions the force of the third errs by 0.55 N, of 34 N at most."""
    real.main([f"data={REAL}", f"out={tmp_path}", "share=0.1", "rows=eflesh force"])
    with (tmp_path / "real.csv").open() as file:
        assert all(float(line["value"]) < 1.0 for line in csv.DictReader(file))


def write_epi(folder, each=40):
    """Write touches in the form of Epi: each gesture has its own number of contacts on its own electrodes."""
    draw, rows = np.random.default_rng(0), []
    for gesture in range(11):
        for _ in range(each):
            values = draw.uniform(0, 3, (12, 100))
            length = draw.integers(5, 8)
            for contact in range(1 + gesture % 4):
                first = 5 + 22 * contact + draw.integers(3)
                values[: 2 + gesture // 4 * 3, first : first + length] += draw.uniform(40, 80)
            rows.append(values.ravel())
    folder.mkdir(parents=True)
    np.savetxt(folder / "training_data_x.csv", rows, delimiter=",", fmt="%.0f")
    (folder / "training_data_y.csv").write_text("\n".join(str(n) for n in np.repeat(range(11), each)))


def test_gestures_are_learnt_from_the_first_touches_and_tested_on_the_last(tmp_path):
    write_epi(tmp_path / real_epi.ROWS[0].path, each=30)
    (line,) = run(tmp_path, "rows=epi gestures")
    assert (line["training"], line["test"], line["reached"]) == ("110", "220", "yes")
    assert float(line["low"]) <= float(line["value"]) <= float(line["high"])
    assert float(line["value"]) > 96


def test_other_rows_stay_in_the_file(tmp_path):
    path = tmp_path / "real.csv"
    for rows in (["epi gestures"], ["eflesh force, 1+2", "eflesh force, 1"], ["epi gestures"]):
        real.write_lines(({"row": row, "value": 0.12345} for row in rows), path)
    with path.open() as file:
        lines = list(csv.DictReader(file))
    assert [line["row"] for line in lines] == ["eflesh force, 1+2", "eflesh force, 1", "epi gestures"]
    assert {line["value"] for line in lines} == {"0.123"}


def write_barometers(path, x, readings, rise=6):
    """Write presses (P, 4), Pa, at places (P,), mm, as the robot's files have them, over drifting offsets."""
    lines = ["Sensor_0,Sensor_1,Sensor_2,Sensor_3,x,z,time"]
    offset, time = np.array([98000.0, 101000, 99000, 100000]), 0.0
    for place, top in zip(x, readings, strict=True):
        for depth in [0.0] * 6 + list(np.linspace(0, 1, rise + 1)[1:]) + [1.0] * 6 + [0.5]:
            values = ",".join(f"{value:.2f}" for value in offset + depth**2 * top)
            lines.append(f"{values},{1e3 * place:.0f},{480 * 4 * depth:.0f},{time:.2f}")
            time += 0.06
        offset = offset + 50
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines))


def test_presses_are_read_above_what_was_before_them(tmp_path):
    x = np.arange(6.0)
    readings = np.random.default_rng(0).uniform(0, 2e4, (6, 4))
    write_barometers(tmp_path / "a.csv", x, readings)
    places, measured = real_barometers.read_frames(tmp_path / "a.csv").plateaus()
    assert places.tolist() == x.tolist()
    np.testing.assert_allclose(measured, 1e-4 * readings, atol=1e-5)
    (tmp_path / "b.csv").write_text("time,s0\n0,1\n")
    with pytest.raises(InputError, match=r"cannot read .*b.csv as a recording of four barometers"):
        real_barometers.read_frames(tmp_path / "b.csv")


@pytest.mark.slow("fits the place of a strip")
def test_a_strip_is_found_from_a_third_of_its_presses_and_places_the_others(tmp_path):
    """The skin is simulated with other gains, and 8 mm beside the robot."""
    about = real_barometers.OmegaConf.load(
        real_barometers.__file__.replace("real_barometers.py", "barometers.yaml")
    )
    body = real_barometers.instantiate(about.body)
    sensors = real_barometers.instantiate(about.layout).sensors(body)
    simulator = real_barometers.instantiate(about.simulator)(body, sensors)
    gains, x = np.array([3e5, 5e5, 4e5, 6e5]), 0.5 * np.arange(60)
    strip = real_barometers.Strip(body, simulator, 0.0025, 0.008, gains, np.zeros(4))
    folder = tmp_path / real_barometers.FOLDER
    write_barometers(folder / f"{real_barometers.CALIBRATED}.csv", x, strip.readings(x) * gains)
    write_barometers(folder / f"{real_barometers.REPEATED}.csv", x[:40], strip.readings(x[:40] + 3) * gains)
    lines = run(tmp_path, "rows=barometers simulated,barometers posterior")
    assert len(lines) == 4
    assert lines[0]["estimator"] == "solid, 5 mm thick, tip of 2.5 mm"
    assert all(float(line["value"]) < 2 for line in lines[:2])
    assert all(float(line["value"]) < 0.5 for line in lines[2:])

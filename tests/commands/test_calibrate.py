"""The command that calibrates: from an emulated bench to a device that trains."""

import pytest

from skin.device.calibration import read_calibration

SMALL = ["layout=grid", "layout.rows=2", "layout.columns=2"]


@pytest.mark.slow("fits and generates a data set")
def test_from_a_bench_to_touches_of_the_calibrated_device(run, tmp_path):
    session, out = tmp_path / "bench.parquet", tmp_path / "mine.yaml"
    words = [*SMALL, f"session={session}", f"out={out}", "calibrate.demo=true", "device.gain_spread=0.2"]
    done = run(tmp_path, "calibrate", *words, store=False)
    assert "Warning" not in done.stderr
    assert "8 presses" in done.stdout
    assert "RMSE on 2 held-out presses" in done.stdout
    assert len(read_calibration(out)) == 4
    touches = tmp_path / "touches.csv"
    words = [*SMALL, "n=16", f"out={touches}", f"device.calibration={out}", "device.randomise=true"]
    run(tmp_path, "generate.py", *words, store=False)
    assert touches.is_file()


@pytest.mark.slow("fits the noise of a data set")
def test_a_calibration_that_does_not_help_ends_with_1_and_writes_nothing(run, tmp_path):
    """A skin that is what the simulation says cannot gain from a fit to its noise."""
    perfect = ["device.gain_spread=0", "device.offset=0", "device.clip=1000"]
    session, out = tmp_path / "bench.csv", tmp_path / "mine.yaml"
    files = f"session={session}", f"out={out}"
    done = run(tmp_path, "calibrate", *SMALL, *perfect, *files, "calibrate.demo=true", store=False, code=1)
    assert "does not reduce the error" in done.stdout
    assert not out.exists()


@pytest.mark.slow("fits a bench")
def test_a_session_with_other_axes_is_refused_until_that_is_confirmed(run, tmp_path):
    session, out = tmp_path / "bench.csv", tmp_path / "mine.yaml"
    files, demo = (f"session={session}", f"out={out}"), "calibrate.demo=true"
    done = run(tmp_path, "calibrate", *SMALL, *files, demo, "calibrate.places=mirror_y", store=False, code=2)
    assert len(done.stderr.strip().splitlines()) == 1
    assert "respond, but not to the presses near their sensors" in done.stderr
    assert "add calibrate.places=as_given" in done.stderr
    assert not out.exists()
    lines = [line.split(",") for line in session.read_text().splitlines()]
    positions = lines[0].index("y_m") if "y_m" in lines[0] else lines[0].index('"y_m"')
    for line in lines[1:]:
        line[positions] = line[positions] and str(0.16 - float(line[positions]))
        line[1], line[2] = line[2], line[1]
    session.write_text("\n".join(map(",".join, lines)) + "\n")
    wrong = ["calibrate.places=mirror_y", "calibrate.channels=[1,0,2,3]"]
    done = run(tmp_path, "calibrate", *SMALL, *files, store=False, code=2)
    assert all(f"{setting}" in done.stderr for setting in wrong)
    done = run(tmp_path, "calibrate", *SMALL, *files, *wrong, store=False)
    assert list(read_calibration(out).channels) == [1, 0, 2, 3]

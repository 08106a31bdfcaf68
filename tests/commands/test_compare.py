"""Presses on a skin give what their number buys: from an emulated bench to a sentence on the alarm."""

import pytest

SKIN = ["simulator=solid", "simulator.divisions=1", "layout=grid", "layout.rows=2", "layout.columns=2"]
PRESSES = ["calibrate.protocol.rest=1.5", "calibrate.protocol.peak=60"]
WATCHED = ["run=any_skin", "evaluation.safe_gestures=64"]


@pytest.mark.slow("chooses a threshold")
def test_eight_presses_show_a_little_and_no_more(run, tmp_path):
    run(tmp_path, "calibrate", *SKIN, *PRESSES, "session=bench.csv", "calibrate.demo=true", store=False)
    words = ["compare", "session=bench.csv", *SKIN]
    done = run(tmp_path, *words, *WATCHED, "out=enough", "compare.miss_rate=0.5", store=False)
    page = (tmp_path / "enough" / "compare.md").read_text()
    assert "above 1.1 x the limit and on a valid sensor: 8 of 8, 0 missed" in page
    assert "- alarm above 0." in page
    assert page in done.stdout
    done = run(tmp_path, *words, *WATCHED, "out=few", "compare.miss_rate=0.05", store=False, code=2)
    assert "0 misses of 8 presses above 1.1 x the limit" in done.stderr
    assert "88 presses are needed" in done.stderr
    assert not (tmp_path / "few").exists()
    done = run(tmp_path, *words, "compare.miss_rate=0.05", store=False, code=2)
    assert "needs presses of known force, and run= whose alarm they test" in done.stderr

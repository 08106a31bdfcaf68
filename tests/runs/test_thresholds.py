"""Every verb raises the alarm where it did: thresholds of all paths on a model that is trained in seconds.

The values were computed once. They are compared to four digits, because processors round differently.
"""

import json

import numpy as np
import pytest

from tests.commands.conftest import query

SKIN = ("layout=grid", "layout.rows=2", "layout.columns=2", "simulator=naive")
MODEL = ("representation=readings", "model=mlp", "fusion=early", "trainer.max_epochs=8")
SAFE = "evaluation.safe_gestures=100"
SMALL = ("data.gestures=400", "device.test_gestures=48", "evaluation.devices=0", "evaluation.layouts=0", SAFE)
FEW = "evaluation.safe_gestures=60"
ROUGH = "evaluation.profile=rough"
EXPECTED = {
    "train": 0.93601, "evaluate": 0.93601, "rate": 0.64427, "profile": 0.99672, "device": 0.96371,
    "adapt": 0.93601, "adapt profile": 0.74935, "train profile": 0.95305, "shipped": 1.0, "drawn": 0.3427,
    "live": [0.99511], "live profile": [0.83851], "live rate": [0.51107],
    "export": [0.97152, 0.98918, 0.99129], "export drawn": [0.92096],
    "written": [0.93601, 1.0, 1.0, 1.0, 0.43095, 0.92096],
}  # fmt: skip


@pytest.fixture(scope="module")
def found(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("thresholds")
    out, values = f"out={folder}/out", {}

    def stored(*words):
        run(folder, *words)
        points = "select value from tags join runs using (run_uuid) where key='operating_point'"
        return json.loads(query(folder, f"{points} order by start_time")[-1][0])["threshold"]

    def per_touch(*words):
        cache = folder / f"cache{len(values)}"
        patch.setenv("SKIN_CACHE", str(cache))
        run(folder, *words, code=None)
        files = sorted(cache.glob("threshold_*.npz"), key=lambda path: path.stat().st_mtime_ns)
        return [float(np.load(path)["point"][0]) for path in files]

    tests = ("device.test_gestures=48", "evaluation.devices=0", "evaluation.layouts=0", SAFE)
    few = ("device=recording", f"device.path={folder}/few.parquet")
    adapted = ("adapt", *few, "adapt.gestures=16", "adapt.epochs=2")
    described = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("skin.runs.onnx_writer.write_model", lambda *words: described.append(words[1]) or 0.0)
        values["train"] = stored("train", *MODEL, *SKIN, *SMALL)
        run(folder, "generate", *SKIN, "profile=rough", "n=20", f"out={folder}/few.parquet", store=False)
        values["evaluate"] = stored("evaluate", out, "device.seed=3")
        values["rate"] = stored("evaluate", out, "evaluation.false_alarm_rate=0.1")
        values["profile"] = stored("evaluate", out, ROUGH, "layout.footprint=[0.02,0.02]")
        words = ("evaluation.profile=device", "profile=rough", "device.dead=0", "device.rate=50")
        values["device"] = stored("evaluate", out, *words)
        values["adapt"] = stored(*adapted, "adapt.scratch=[]")
        values["adapt profile"] = stored(*adapted, "adapt.scratch=[extra_trees]", ROUGH)
        own = "run=" + query(folder, "select run_uuid from runs order by start_time")[0][0]
        values["train profile"] = stored("train", *MODEL, *SKIN, *SMALL, ROUGH)
        shipped = ("run=default_skin", SKIN[3], *tests, "evaluation.profile=mild")
        values["shipped"] = stored("evaluate", out, *shipped)
        values["drawn"] = stored("evaluate", "run=any_skin", out, "device=simulated", *SKIN, *tests)
        still = ("live.selftest=false", "live.contacts=false", "seconds=0.1", "live.touch=0.3")
        live = ("live.py", own, *still, FEW)
        values["live"] = per_touch(*live)
        values["live profile"] = per_touch(*live, ROUGH)
        values["live rate"] = per_touch(*live, "evaluation.false_alarm_rate=0.1", "live.patience.alarm=0")
        export = ("export", "export.touches=10", "export.touch=0.3", f"out={folder}/x.onnx")
        values["export"] = per_touch(*export, own, FEW, "export.rates=[10,47,500]")
        values["export drawn"] = per_touch(*export, "run=any_skin", *SKIN, FEW, "export.rates=[100]")
    values["written"] = [each for one in described for each in (one.threshold, *one.thresholds.values())]
    return values


@pytest.mark.slow("trains, evaluates, adapts, exports and watches, with touches drawn for each")
@pytest.mark.parametrize("path", EXPECTED)
def test_every_path_uses_the_threshold_that_it_used(found, path):
    assert json.loads(json.dumps(found[path])) == pytest.approx(EXPECTED[path], abs=1e-4)

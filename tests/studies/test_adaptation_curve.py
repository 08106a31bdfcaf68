"""The learning curve of an adaptation: zero-shot, adapted, and models trained on the same gestures."""

from copy import deepcopy

import torch
from hydra import initialize_config_dir

from experiments.studies.adaptation_curve import measure_adaptation
from experiments.studies.subject import Finished, Subject
from skin.build import build_data, build_device, build_learner
from skin.model_of_run import RunModel
from skin.paths import CONF

SETTINGS = [
    "simulator=naive", "layout=grid", "layout.rows=2", "layout.columns=2", "representation=features",
    "model=mlp", "model.widths=[]", "fusion.head=residual", "fusion.hidden=16", "optimizer.lr=0.003",
    "data.gestures=200", "device.test_gestures=96", "trainer.max_epochs=4",
]  # fmt: skip


def test_a_run_is_measured_before_and_after_and_is_itself_again_then(configured):
    config = configured(*SETTINGS)
    device = build_device(config)
    learner = build_learner(config)
    learner.fit(build_data(config, device))
    before = deepcopy(learner.network.state_dict())
    trained = RunModel(device, learner, device.touches("train")[:1])
    other = device.replace(gestures=300, data_seed=1, gain_spread=0.5, time_constant=0.4, seed=2)
    subject = Subject(config, other, Finished(None, None, config, trained))
    quick = {"layers": ["all"], "lr": [1e-3], "epochs": 15}
    with initialize_config_dir(str(CONF), version_base="1.3"):
        found = measure_adaptation(subject, ["rules"], None, quick).metrics
    assert {f"{model}/overall/accuracy" for model in ("zero_shot", "adapted", "rules")} <= set(found)
    assert found["adapted/changed"] == 1
    assert found["adapted/overall/accuracy"] > found["zero_shot/overall/accuracy"]
    after = learner.network.state_dict()
    assert all(torch.equal(after[name], before[name]) for name in before)

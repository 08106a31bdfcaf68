"""The arm from end to end: what works on a sheet works on it, in its chart."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from skin.device.files import read_recording
from skin.runs.build import build_data, build_device

SOLID = "simulator=solid", "simulator.divisions=1", "body.cells=[10,10]", "layout=grid"
FEW = "data.gestures=16", "device.test_gestures=16"


@pytest.mark.slow("generates and trains on an arm")
def test_generated_touches_train_and_are_evaluated(run, tmp_path):
    arm = "body=arm", "body.angle=2.5", "layout=grid"
    run(tmp_path, "generate.py", *arm, "simulator=naive", "n=48", "out=arm.parquet", store=False)
    assert read_recording(tmp_path / "arm.parquet").size == pytest.approx((0.125, 0.16))
    recording = *arm, "device=recording", "device.path=arm.parquet"
    run(tmp_path, "train.py", *recording, "experiment=temporal_graph", "trainer.max_epochs=1")
    run(tmp_path, "evaluate.py", "run=latest", f"out={tmp_path}")
    assert list(tmp_path.glob("evaluation_recording_*.md"))


@pytest.mark.parametrize("representation", ["image", "interp", "graph", "features"])
def test_without_mechanics_an_arm_shows_what_a_sheet_of_its_size_shows(configured, representation):
    """Touches, labels and pictures live in the chart, so nothing but mechanics can tell the two apart."""
    shown = []
    for body in ("sheet", "arm"):
        words = f"body={body}", f"representation={representation}", "simulator=naive", FEW[0]
        config = configured(*words)
        device = build_device(config)
        frames, labels = build_data(config, device).frames(device.touches("holdout"))
        shown.append([labels, frames.x] + [frames.adjacency] * (representation == "graph"))
    for sheet, arm in zip(*shown, strict=True):
        torch.testing.assert_close(arm, sheet)


def test_sensors_on_the_arm_move_and_graphs_follow_them(configured):
    graph = "representation=graph", "representation.positions=deformed"
    config = configured("body=arm", *SOLID, *FEW, *graph, "fusion=late", "model=gcn")
    device = build_device(config)
    movie = device.sampler.sample(16, np.random.default_rng(0))
    motion = device.model.motion(movie.frames)[movie.index] * movie.scale[..., None, None]
    assert motion.abs().amax(dim=(0, 1, 2)).min() > 1e-5
    frames, _ = build_data(config, device).frames(replace(device.touches("test"), motion=motion))
    assert frames.adjacency.shape == (16, 30, 25, 25)
    assert (frames.adjacency[:, 1:] != frames.adjacency[:, :1]).any()

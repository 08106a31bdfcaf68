"""Small untrained networks: their weights do not matter here."""

from pathlib import Path

import pytest
import torch
from filelock import FileLock

from skin.runs.build import TorchModel, build_data, build_device, build_learner

SMALL = ["simulator=naive", "layout=grid", "layout.rows=2", "layout.columns=3", "data.gestures=96"]


@pytest.fixture(scope="session")
def untrained(configured):
    def build(*overrides: str) -> TorchModel:
        config = configured(*SMALL, *overrides)
        device, learner = build_device(config), build_learner(config)
        data = build_data(config, device)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            learner.build(data)
        return TorchModel(device, learner, data.example, touch=0.3)

    return build


@pytest.fixture(scope="session")
def exported(untrained, shared) -> tuple[TorchModel, Path]:
    """Return the run with features, and its exported file, which one process writes for all."""
    pytest.importorskip("onnxruntime")
    from skin.runs.onnx_writer import write_model

    of, path = untrained("experiment=best_fresh"), shared / "exported" / "skin.onnx"
    with FileLock(f"{path.parent}.lock"):
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            new = path.with_name("new.onnx")
            write_model(of.learner.pipeline(of.sites), of.describe(), of.device.touches("train"), new)
            new.rename(path)
    return of, path

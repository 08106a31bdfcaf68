"""Exported files against the networks that they come from."""

import numpy as np
import pytest
import torch

from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.graph import Graph
from skin.learning.learner import Rules
from skin.runs.model import OnnxModel

pytest.importorskip("onnxruntime")
from skin.runs.onnx_writer import TOLERANCE, write_model


def difference(of, path, readings, valid):
    expected = of.learner.probabilities(Touches(readings, valid, of.sites, None, of.rate))
    found = OnnxModel(path).probabilities(readings.numpy(), valid.numpy())
    assert found.shape == tuple(expected.shape)
    return float(np.abs(found - expected.numpy()).max())


@pytest.mark.slow("computes a thousand touches twice")
def test_a_thousand_touches_have_the_probabilities_of_torch(exported):
    of, path = exported
    touches = of.device.replace(gestures=10_000).touches("validation")
    assert len(touches) == 1000
    assert difference(of, path, touches.readings, touches.valid) <= TOLERANCE
    expected = of.learner.probabilities(touches)
    assert (expected.amax(0) - expected.amin(0)).min() > 100 * TOLERANCE  # the outputs do depend on the touch


@pytest.mark.parametrize("batch", [1, 2, 7])
def test_a_batch_may_have_any_size(exported, batch):
    of, path = exported
    touches = of.device.touches("test")[:batch]
    assert difference(of, path, touches.readings, touches.valid) <= TOLERANCE


def test_invalid_readings_idle_windows_and_single_sensors(exported):
    of, path = exported
    generator = torch.Generator().manual_seed(0)
    readings = 3 * torch.rand(5, of.window, len(of.positions), generator=generator)
    valid = torch.rand(readings.shape, generator=generator) > 0.2
    readings[0] = 0.0
    readings[1, :, 1:] = 0.0
    readings[2][~valid[2]] = torch.nan
    valid[3, :, 2], readings[3, :, 2] = False, torch.nan
    valid[4] = False
    assert difference(of, path, readings, valid) <= TOLERANCE


@pytest.mark.slow("exports a network for each set of options")
@pytest.mark.parametrize(
    "overrides",
    [
        ["representation=readings", "model=mlp", "fusion=early"],
        ["experiment=gru"],
        ["experiment=sequence_graph"],
        ["experiment=temporal_image"],
    ],
    ids=lambda overrides: overrides[0],
)
def test_other_networks(untrained, tmp_path, overrides):
    of = untrained(*overrides)
    described = of.describe()
    touches = of.device.touches("train")
    found = write_model(of.learner.pipeline(of.sites), described, touches, tmp_path / "skin.onnx")
    assert found <= TOLERANCE


def test_a_learner_that_is_no_network_is_refused():
    with pytest.raises(InputError, match="Rules cannot be exported: give a run of learner=network"):
        Rules().pipeline(torch.zeros(4, 3))


def test_a_graph_per_frame_is_refused_and_nothing_is_written(untrained, tmp_path):
    of = untrained("experiment=sequence_graph")
    described, touches = of.describe(), of.device.touches("test")[:9]
    pipeline = of.learner.pipeline(of.sites)
    pipeline.representation = Graph(of.sites, of.device.size, positions="deformed")
    with pytest.raises(InputError, match="needs touches with displacements"):
        write_model(pipeline, described, touches, tmp_path / "x.onnx")
    assert not list(tmp_path.iterdir())


def test_a_file_that_differs_is_not_written(exported, tmp_path):
    of, _ = exported

    class Drifting(torch.nn.Module):
        """Gives another answer in an export."""

        def forward(self, readings, valid):
            return readings.mean(dim=1)[:, :4].sigmoid() + torch.compiler.is_exporting()

    described = of.describe()
    with pytest.raises(InputError, match="would differ from the network by 1"):
        write_model(Drifting(), described, of.device.touches("train"), tmp_path / "skin.onnx")
    assert not list(tmp_path.iterdir())

"""Exported files and translated operators against the networks of torch."""

import warnings

import numpy as np
import pytest
import torch
from torch import nn

from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.graph import Graph
from skin.learning.learner import Rules
from skin.runs.model import OnnxModel

pytest.importorskip("onnxruntime")
import onnxruntime

from skin.runs.onnx_writer import TOLERANCE, TRANSLATIONS, write_model


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


class Operators(nn.Module):
    """Every operator that has a translation."""

    def forward(self, rows, counts, pairs, matrices):
        medians, maxima = rows.nanmedian(dim=1).values.nan_to_num(-1), counts.cummax(dim=1).values
        return medians, maxima, torch.linalg.eigvalsh(pairs), torch.linalg.svdvals(matrices)[:, :4]


@pytest.fixture(scope="module")
def translated(tmp_path_factory):
    path = tmp_path_factory.mktemp("operators") / "operators.onnx"
    example = torch.rand(3, 9), torch.ones(3, 6, 2, dtype=torch.int32), torch.eye(2)[None].repeat(3, 1, 1)
    names = ["rows", "counts", "pairs", "matrices"]
    settings = {"dynamo": True, "opset_version": 20, "verbose": False, "input_names": names}
    settings |= {"dynamic_shapes": ({0: torch.export.Dim("batch")},) * 4}
    settings |= {"custom_translation_table": TRANSLATIONS}
    with warnings.catch_warnings(action="ignore"):
        torch.onnx.export(Operators(), (*example, torch.rand(3, 8, 5)), path, **settings)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    names = [given.name for given in session.get_inputs()]
    return lambda *given: session.run(None, dict(zip(names, [one.numpy() for one in given], strict=True)))


def rank(values, seed):
    generator = np.random.default_rng(seed)
    left, right = (np.linalg.qr(generator.normal(size=(n, n)))[0] for n in (8, 5))
    return (left[:, :5] * values) @ right


def test_they_agree_with_torch(translated):
    generator = torch.Generator().manual_seed(0)
    rows = torch.rand(6, 9, generator=generator)
    rows[0, :4], rows[1, :8], rows[2] = torch.nan, torch.nan, torch.nan
    counts = torch.randint(0, 9, (6, 6, 2), generator=generator, dtype=torch.int32)
    pairs = torch.rand(6, 2, 2, generator=generator)
    pairs = pairs @ pairs.mT
    pairs[0], pairs[1] = 0.0, torch.ones(2, 2)
    # Equal, nearly equal, widely spread, and vanishing singular values.
    given = [[1, 1, 1, 1, 1], [3, 2.9999, 2.9998, 1, 0], [9, 1, 0.1, 1e-3, 1e-4], [2, 0, 0, 0, 0]]
    given += [[5, 4.99, 1e-2, 9e-3, 8e-3], [0, 0, 0, 0, 0]]
    matrices = torch.from_numpy(np.stack([rank(values, n) for n, values in enumerate(given)])).float()
    expected = Operators()(rows, counts, pairs, matrices)
    found = translated(rows, counts, pairs, matrices)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other.numpy(), atol=3e-6, rtol=1e-6)

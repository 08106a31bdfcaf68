"""The fast rows and their plain twins are the same networks, to 1e-5 in outputs and gradients."""

import warnings
from importlib import import_module

import pytest
import torch
from hydra.utils import instantiate
from torch.nn import functional as F

from skin.body.layout import File
from skin.core.files import ROOT
from skin.device.base import AbstractDevice
from skin.device.touches import Touches
from skin.learning.data import TouchData


@pytest.fixture(scope="module")
def plain():
    with warnings.catch_warnings():
        # PyTorch Geometric compiles with torch.jit.script while it is imported
        warnings.filterwarnings("ignore", "`torch.jit.script", DeprecationWarning)
        return import_module("tests.reference_models")


class Device(AbstractDevice):
    """Yields six touches of random readings on the default layout."""

    def __init__(self, task, body):
        self.task, self.size = task, body.size
        positions = torch.from_numpy(
            File(ROOT / "data/layouts/jittered_5x5.csv").sensors(body).positions
        ).float()
        generator = torch.Generator().manual_seed(0)
        readings = 10 * torch.rand(6, 30, 25, generator=generator)
        labels = torch.rand(6, 4, generator=generator).round()
        self.fixed = Touches(readings, torch.ones_like(readings, dtype=torch.bool), positions, labels, 10.0)

    def touches(self, split, epoch=0):
        return self.fixed


@pytest.mark.parametrize("row", ["temporal_graph", "sequence_graph", "temporal_image", "sequence_image"])
def test_the_plain_twin_computes_the_same(row, plain, configured, made_up_device):
    config = configured(f"experiment={row}")
    device = Device(made_up_device.task, instantiate(config.body))
    data = TouchData(device, instantiate(config.representation))
    torch.manual_seed(0)
    learner = instantiate(config.learner)
    ours = learner.build(data).eval()
    twin = plain.PLAIN[row]().eval()
    plain.take_weights(twin, ours)

    frames, labels = data.frames(device.fixed)
    samples = twin.samples(device.fixed, device.size)
    logits = ours(frames), twin(twin.collate([samples[i] for i in range(6)]))
    assert (logits[0] - logits[1]).abs().max() < 1e-5
    assert logits[0].std() > 1e-3  # not merely two constants

    for network, output in zip((ours, twin), logits, strict=True):
        network.zero_grad()
        F.binary_cross_entropy_with_logits(output, labels).backward()
    theirs = [parameter.grad for parameter in twin.parameters()]
    for ours_, theirs_ in zip((p.grad for p in ours.parameters()), theirs, strict=True):
        assert (ours_ - theirs_).abs().max() <= 1e-5 * max(1, float(theirs_.abs().max()))

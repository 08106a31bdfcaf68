"""Translated operators against torch, alone."""

import numpy as np
import pytest
import torch
from torch import nn

from skin.runs.onnx_writer import _quiet

onnxruntime = pytest.importorskip("onnxruntime")


class Operators(nn.Module):
    """Every operator that has a translation."""

    def forward(self, rows, counts, pairs, matrices):
        strength = torch.linalg.svdvals(matrices)[:, :4]
        return (
            rows.nanmedian(dim=1).values.nan_to_num(-1),
            counts.cummax(dim=1).values,
            torch.linalg.eigvalsh(pairs),
            strength,
        )


@pytest.fixture(scope="module")
def translated(tmp_path_factory):
    """Return a function that computes the operators with ONNX Runtime."""
    from skin.runs.onnx_writer import TRANSLATIONS

    path = tmp_path_factory.mktemp("operators") / "operators.onnx"
    example = torch.rand(3, 9), torch.ones(3, 6, 2, dtype=torch.int32), torch.eye(2)[None].repeat(3, 1, 1)
    batch = {0: torch.export.Dim("batch")}
    with _quiet():
        torch.onnx.export(
            Operators(),
            (*example, torch.rand(3, 8, 5)),
            path,
            dynamo=True,
            dynamic_shapes=(batch,) * 4,
            input_names=["rows", "counts", "pairs", "matrices"],
            opset_version=20,
            custom_translation_table=TRANSLATIONS,
            verbose=False,
        )
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    names = [given.name for given in session.get_inputs()]
    return lambda *given: session.run(None, dict(zip(names, [one.numpy() for one in given], strict=True)))


def rank(values, seed):
    """Return a matrix (8, 5) with given singular values."""
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

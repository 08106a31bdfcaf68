"""The largest strain of the linear solution, against what is known and against a direct look at it."""

import numpy as np
import pytest
import torch

from skin.body.base import Sensors, Sheet
from skin.mechanics.simulator.base import largest_strain
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.naive import Naive
from skin.mechanics.simulator.solid import Solid

SOFT = {"name": "soft", "young": 1e5, "poisson": 0.3}
BODY = Sheet(
    [0.2, 0.2], [10, 10], [{"material": SOFT, "thickness": 0.01}, {"material": SOFT, "thickness": 0.005}]
)
SENSORS = Sensors(np.array([[0.1, 0.1, 0.005]]), (0.01, 0.01))


def test_plates_and_beams_are_squeezed_like_a_column():
    """Under even pressure each layer is a column: p / E, but at the free edges."""
    strain = PlatesAndBeams(BODY, SENSORS).strain(torch.full((1, 10, 10), 2e4))
    assert strain.item() == pytest.approx(0.2, rel=0.1)


def test_a_wide_solid_is_squeezed_as_in_an_oedometer():
    """Confined: p (1 + nu) (1 - 2 nu) / (E (1 - nu)) in the middle; the free edges bulge further."""
    confined = 2e4 * 1.3 * 0.4 / (1e5 * 0.7)
    even = torch.full((1, 10, 10), 2e4)
    assert confined < Solid(BODY, SENSORS, divisions=2).strain(even).item() < 2 * confined


def test_it_grows_with_the_load_and_with_friction():
    skin, frame = Solid(BODY, SENSORS, divisions=2), torch.zeros(2, 10, 10)
    frame[:, 4:6, 4:6] = torch.tensor([1e3, 3e3])[:, None, None]
    alone = skin.strain(frame)
    assert alone[1] / alone[0] == pytest.approx(3, rel=1e-5)
    assert (skin.strain(frame, torch.tensor([[0.8, 0.0]]).expand(2, 2)) > 1.02 * alone).all()


def test_the_principal_strain_is_numpys():
    rows = torch.randn(6, 4, 5, generator=torch.Generator().manual_seed(0))
    cells = torch.rand(3, 5, generator=torch.Generator().manual_seed(1))
    xx, yy, zz, yz, xz, xy = torch.einsum("fc,kpc->kfp", cells, rows).double().numpy()
    tensors = np.stack([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 3, 0, 1)
    at = np.linalg.norm(tensors, axis=(2, 3)).argmax(axis=1)
    principal = np.abs(np.linalg.eigvalsh(tensors[np.arange(3), at])).max(axis=1)
    assert largest_strain(cells, rows).numpy() == pytest.approx(principal, rel=1e-5)


def test_without_mechanics_nobody_knows():
    assert Naive(BODY, SENSORS).strain(torch.ones(1, 10, 10)) is None

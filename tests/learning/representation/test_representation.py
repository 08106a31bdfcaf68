"""Readings as they are, as images, and as spectra of images."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from skin.body.base import GEOMETRY
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning import representation
from skin.learning.graph import Graph
from skin.learning.representation import Fourier, Image, Readings, Sites

# Interpolation against planes and brute force.
SIZE = (0.16, 0.12)


def image(positions, readings, **options):
    given = torch.tensor(readings)[None, None]
    represent = Image(torch.tensor(positions), (0.16, 0.08), **options)
    return represent(given, torch.ones_like(given, dtype=torch.bool)).x[0, 0, 0]


def test_x_is_the_column_and_y_the_row_also_on_an_oblong_sheet():
    picture = image([[0.15, 0.01, 0.0], [0.01, 0.07, 0.0]], [5.0, 10.0], pixels=16)
    assert picture[2, 15] == 0.5
    assert picture[14, 1] == 1.0
    assert picture.count_nonzero() == 2


@pytest.mark.parametrize("kind", [Fourier, Graph, Image, representation.Interpolation])
def test_three_axes_of_a_site_are_three_features_of_one_place(kind):
    """Each is what a skin with sensors along this axis alone shows; masks come behind all readings."""
    places = torch.tensor([[0.02, 0.01, 0.0], [0.05, 0.06, 0.0], [0.11, 0.03, 0.0], [0.15, 0.07, 0.0]])
    readings, valid = torch.randn(2, 5, 12), torch.rand(2, 5, 12) > 0.2
    alone, three = (
        kind(sites, (0.16, 0.08), mask=True) for sites in (places, places.repeat_interleave(3, 0))
    )
    frames = three(readings, valid)
    along = -1 if kind is Graph else 2
    parts = [alone(readings[..., axis::3], valid[..., axis::3]) for axis in range(3)]
    values, masks = zip(*(part.x.split(1, dim=along) for part in parts), strict=True)
    torch.testing.assert_close(frames.x, torch.cat([*values, *masks], dim=along))
    assert kind is not Graph or torch.equal(frames.adjacency, parts[0].adjacency)


def test_sensors_on_one_pixel_are_averaged():
    picture = image([[0.101, 0.041, 0.0], [0.1011, 0.0412, 0.0], [0.02, 0.02, 0.0]], [2.0, 4.0, 6.0])
    torch.testing.assert_close(picture[picture != 0].sort().values, torch.tensor([0.3, 0.6]))


def test_the_spectrum_is_that_of_numpy(made_up_device):
    touches = made_up_device.touches("test")[:3]
    given = touches.positions, made_up_device.size
    image = Image(*given, pixels=48)(touches.readings, touches.valid).x.double().numpy()
    wanted = np.log(1 + np.abs(np.fft.fftshift(np.fft.fft2(image), axes=(-2, -1))))
    spectrum = Fourier(*given, pixels=48)(touches.readings, touches.valid).x
    np.testing.assert_allclose(spectrum.numpy(), wanted, atol=1e-5)


def test_readings_then_their_mask():
    readings = torch.tensor([[[1.0, 2.0, 3.0]]])
    valid = torch.tensor([[[True, False, True]]])
    x = Readings(torch.zeros(3, 3), (0.16, 0.16), scale=2.0, mask=True)(readings, valid).x
    assert x.tolist() == [[[0.5, 0.0, 1.5, 0.0, 1.0, 0.0]]]


def test_both_views_of_one_newton_above_idle():
    readings = torch.zeros(1, 30, 5)
    readings[0, 20, 2] = 1.0
    represent = representation.Features(torch.rand(5, 3), (1.0, 1.0))
    x = represent(readings, torch.ones_like(readings, dtype=torch.bool)).x[0, 20]
    assert x[2] == pytest.approx(1 / 3)
    # asinh(1 / 0.2) = ln(5 + sqrt(26))
    assert x[5 + 2] == pytest.approx(2.3124383 / 2)
    assert x.count_nonzero() == 2


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform((0.01, 0.01), (0.15, 0.11), (20, 2))


@pytest.mark.parametrize(("method", "tolerance"), [("linear", 1e-12), ("cubic", 1e-8)])
def test_a_plane_is_reproduced_inside_the_hull(points, method, tolerance):
    def plane(xy):
        return 3 + 40 * xy[:, 0] - 70 * xy[:, 1]

    targets = representation.centres(SIZE, 64)
    inside = Delaunay(points).find_simplex(targets) >= 0
    values = representation.weights(points, targets, method) @ plane(points)
    assert inside.sum() > 1000
    assert np.abs(values - plane(targets))[inside].max() < tolerance


@pytest.mark.parametrize("method", ["linear", "cubic"])
def test_outside_the_hull_the_nearest_value_holds(points, method):
    targets = representation.centres(SIZE, 48)
    outside = Delaunay(points).find_simplex(targets) < 0
    assert outside.sum() > 100
    np.testing.assert_array_equal(
        representation.weights(points, targets, method)[outside],
        representation.weights(points, targets, "nearest")[outside],
    )


def test_sensors_in_a_line_are_refused(points):
    with pytest.raises(InputError, match=r"got 3: set representation\.method=nearest"):
        representation.weights(np.array([[0.0, 0.0], [0.1, 0.1], [0.2, 0.2]]), points, "linear")


# Virtual sites do not depend on the number and the order of the sensors.


@pytest.fixture
def touches():
    """Five touches of nine sensors on a skin of 0.2 x 0.1 m; one sensor is dead in the first touch."""
    generator = torch.Generator().manual_seed(0)
    readings = torch.rand(5, 12, 9, generator=generator)
    sites = torch.rand(9, 2, generator=generator) * torch.tensor([0.2, 0.1])
    geometry = torch.rand(9, len(GEOMETRY), generator=generator)
    geometry[:, :2] = sites
    geometry[:, GEOMETRY.index("width")], geometry[:, GEOMETRY.index("height")] = 0.2, 0.1
    valid = torch.ones(5, 12, 9, dtype=torch.bool)
    valid[0, :, 3] = False
    positions = torch.cat([sites, torch.full((9, 1), 0.005)], dim=1)
    return Touches(readings, valid, positions, None, 10.0, geometry=geometry, saturated=readings > 0.98)


def shown(touches):
    return Sites(touches.positions, (0.2, 0.1)).show(touches)


def test_the_shape_does_not_depend_on_the_sensors(touches):
    frames = shown(touches)
    assert frames.x.shape == (5, 12, 36 * 3 * 4 + 2 * 10 + 2)
    assert frames.summary.shape == (5, 1 + 3 * len(GEOMETRY) + 36 * 3 + 107)
    assert torch.isfinite(frames.x).all()
    assert torch.isfinite(frames.summary).all()


def test_the_order_of_sensors_does_not_matter(touches):
    order = torch.randperm(9, generator=torch.Generator().manual_seed(1))
    series = {name: getattr(touches, name)[..., order] for name in ("readings", "valid", "saturated")}
    other = replace(touches, **series, positions=touches.positions[order], geometry=touches.geometry[order])
    for found, expected in zip(shown(other)[::2], shown(touches)[::2], strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("filled", [0.0, 100.0])
def test_a_dead_sensor_changes_nothing(touches, filled):
    extra = torch.full((5, 12, 1), torch.nan)
    other = replace(
        touches,
        readings=torch.cat([touches.readings, extra], dim=2),
        valid=torch.cat([touches.valid, extra == 0], dim=2),
        saturated=torch.cat([touches.saturated, extra != extra], dim=2),
        positions=torch.cat([touches.positions, torch.zeros(1, 3)]),
        geometry=torch.cat([touches.geometry, filled * torch.ones(1, len(GEOMETRY))]),
    )
    for found, expected in zip(shown(other)[::2], shown(touches)[::2], strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_each_touch_may_have_a_skin_of_its_own(touches):
    geometry = touches.geometry.expand(5, 9, len(GEOMETRY)).clone()
    each = replace(touches, positions=touches.positions.expand(5, 9, 3), geometry=geometry)
    torch.testing.assert_close(shown(each).x, shown(touches).x)
    each.geometry[2, :, 0] /= 2
    moved = (shown(each).x - shown(touches).x).abs().amax((1, 2))
    assert (moved > 1e-3).tolist() == [False, False, True, False, False]


def test_a_reading_appears_at_the_site_where_its_sensor_is(touches):
    readings = torch.zeros(1, 12, 9)
    readings[:, 11, 4] = 2.0
    valid = torch.ones(1, 12, 9, dtype=torch.bool)
    one = replace(touches[:1], readings=readings, saturated=None, valid=valid)
    linear = shown(one).x[0, 11, : 36 * 4].view(36, 4)[:, 0]
    x, y = one.positions[4, :2] / torch.tensor([0.2, 0.1])
    middles = (torch.arange(6) + 0.5) / 6
    sites = torch.stack(torch.meshgrid(middles, middles, indexing="xy"), -1)
    distance = (sites.flatten(0, 1) - torch.stack([x, y])).norm(dim=1)
    assert distance[linear.argmax()] < 0.35
    assert linear.max() <= 2.0 / 3.0 + 1e-6


def test_touches_of_unknown_mechanics_are_refused(touches):
    with pytest.raises(InputError, match="representation=sites needs to know what each sensor responds to"):
        shown(replace(touches, geometry=None))

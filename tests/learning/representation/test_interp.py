"""Interpolation against planes and brute force."""

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from scipy.spatial import Delaunay

from skin.errors import InputError
from skin.learning.representation import Interpolation, centres, weights

SIZE = (0.16, 0.12)


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform((0.01, 0.01), (0.15, 0.11), (20, 2))


@pytest.mark.parametrize(("method", "tolerance"), [("linear", 1e-12), ("cubic", 1e-8)])
def test_a_plane_is_reproduced_inside_the_hull(points, method, tolerance):
    def plane(xy):
        return 3 + 40 * xy[:, 0] - 70 * xy[:, 1]

    targets = centres(SIZE, 64)
    inside = Delaunay(points).find_simplex(targets) >= 0
    values = weights(points, targets, method) @ plane(points)
    assert inside.sum() > 1000
    assert np.abs(values - plane(targets))[inside].max() < tolerance


def test_nearest_is_that_of_brute_force(points):
    targets = centres(SIZE, 48)
    nearest = np.linalg.norm(targets[:, None] - points, axis=2).argmin(axis=1)
    assert (weights(points, targets, "nearest").argmax(axis=1) == nearest).all()
    assert (weights(points, targets, "nearest").sum(axis=1) == 1).all()


@pytest.mark.parametrize("method", ["linear", "cubic"])
def test_outside_the_hull_the_nearest_value_holds(points, method):
    targets = centres(SIZE, 48)
    outside = Delaunay(points).find_simplex(targets) < 0
    assert outside.sum() > 100
    np.testing.assert_array_equal(
        weights(points, targets, method)[outside], weights(points, targets, "nearest")[outside]
    )


def test_cubic_is_linear_in_the_readings(points):
    from scipy.interpolate import CloughTocher2DInterpolator

    values = np.random.default_rng(1).normal(size=len(points))
    targets = centres(SIZE, 48)
    inside = Delaunay(points).find_simplex(targets) >= 0
    direct = CloughTocher2DInterpolator(points, values, tol=1e-12, maxiter=5000)(targets)
    np.testing.assert_allclose(
        (weights(points, targets, "cubic") @ values)[inside], direct[inside], atol=1e-7
    )


def test_sensors_in_a_line_are_refused(points):
    with pytest.raises(InputError, match=r"got 3: set representation\.method=nearest"):
        weights(np.array([[0.0, 0.0], [0.1, 0.1], [0.2, 0.2]]), points, "linear")


METHODS = ["nearest", "linear", "cubic"]


@pytest.fixture
def given(made_up_device):
    touches = made_up_device.touches("test")[:3]
    valid = touches.valid.clone()
    valid[:, 4, 5] = False
    return touches.positions, touches.readings, valid


@pytest.mark.parametrize("pixels", [48, 64, 128])
def test_several_methods_give_a_channel_each(given, pixels):
    positions, readings, valid = given
    together = Interpolation(positions, SIZE, METHODS, pixels)(readings, valid).x
    assert together.shape == (3, 10, 3, pixels, pixels)
    for channel, method in enumerate(METHODS):
        alone = Interpolation(positions, SIZE, method, pixels)(readings, valid).x
        torch.testing.assert_close(together[:, :, channel : channel + 1], alone)


def test_the_mask_of_several_methods_follows_their_values(given):
    positions, readings, valid = given
    x = Interpolation(positions, SIZE, METHODS, mask=True)(readings, valid).x
    plain = Interpolation(positions, SIZE, METHODS)
    torch.testing.assert_close(x[:, :, :3], plain(readings, valid).x)
    wanted = plain(10 * (~valid).float(), torch.ones_like(valid)).x
    torch.testing.assert_close(x[:, :, 3:], wanted)
    assert (wanted.amax(dim=(-2, -1)) > 0.5).sum() == 3 * 3  # in frame 4 of each touch, by each method


def test_three_interpolations_feed_an_image_model_of_three_channels(configured, given):
    positions, readings, valid = given
    config = configured("representation=interp", "representation.method=[nearest,linear,cubic]", "model=cnn")
    frames = instantiate(config.representation)(positions, SIZE)(readings, valid)
    model = instantiate(config.model, repeat=1)("image", tuple(frames.x.shape[2:]))
    assert model.convolutions[0].weight.shape[1] == 3
    assert model(frames.x.flatten(0, 1), None).shape == (30, model.width)


def test_bad_lists_of_methods_are_refused(given):
    positions, _, _ = given
    for wrong in ([], ["nearest", "quintic"], "quintic", 3):
        with pytest.raises(InputError, match=r"^representation\.method=.*: as in .*=linear$"):
            Interpolation(positions, SIZE, wrong)

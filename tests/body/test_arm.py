"""The arm: a sheet rolled up, and what is refused."""

import numpy as np
import pytest

from skin.body.arm import Arm
from skin.errors import InputError

LAYERS = [
    {"material": {"name": "Dragon Skin 10 Medium", "poisson": 0.49}, "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]


def arm(**changes) -> Arm:
    return Arm(**{"radius": 0.05, "length": 0.2, "angle": 2.0, "cells": [8, 6], "layers": LAYERS, **changes})


def test_places_by_hand():
    """A half sleeve of 5 cm: its edges lie level with the axis, its middle on top."""
    half = arm(angle=np.pi)
    edge = np.pi * 0.05
    chart = [[0, 0, 0], [edge / 2, 0.1, 0], [edge, 0.2, 0], [edge / 2, 0.1, 0.015], [edge, 0, 0.015]]
    space = [[-0.05, 0, 0], [0, 0.1, 0.05], [0.05, 0.2, 0], [0, 0.1, 0.035], [0.035, 0, 0]]
    np.testing.assert_allclose(half.locate(np.array(chart)), space, atol=1e-15)
    top = half.frame(np.array([edge / 2, 0.1, 0.0]))
    np.testing.assert_allclose(top, [[1, 0, 0], [0, 1, 0], [0, 0, -1]], atol=1e-15)
    np.testing.assert_allclose(half.frame(np.zeros(3)), [[0, 0, 1], [0, 1, 0], [1, 0, 0]], atol=1e-15)


def test_all_places_lie_on_the_cylinder_and_into_the_skin_is_to_its_axis():
    body, rng = arm(), np.random.default_rng(0)
    given = rng.uniform(size=(100, 3)) * [*body.size, body.thickness]
    space, into = body.locate(given), body.frame(given)[:, 2]
    radius = np.hypot(space[:, 0], space[:, 2])
    np.testing.assert_allclose(radius, 0.05 - given[:, 2])
    np.testing.assert_allclose(space + radius[:, None] * into, space * [0, 1, 0], atol=1e-15)


def test_straight_lines_of_the_chart_are_the_shortest_on_the_surface():
    """Distances between sensors: the helix's length by small steps in space, and no detour is shorter."""
    body = arm()
    first, second = np.array([0.01, 0.03, 0.0]), np.array([0.09, 0.15, 0.0])
    fraction = np.linspace(0, 1, 2001)[:, None]
    helix = first + fraction * (second - first)
    along = np.linalg.norm(np.diff(body.locate(helix), axis=0), axis=1).sum()
    assert along == pytest.approx(np.linalg.norm(second - first), rel=1e-6)
    for bend in (-0.01, 0.01):
        detour = helix + bend * np.sin(np.pi * fraction) * [1, 0, 0]
        assert np.linalg.norm(np.diff(body.locate(detour), axis=0), axis=1).sum() > along


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"radius": 0}, "body.radius=0 must be greater than 0"),
        ({"length": -1}, "body.length=-1 must be greater than 0"),
        ({"length": "long"}, "body.length=long must be a valid number"),
        ({"angle": float("nan")}, "body.angle=nan must be a finite number"),
        ({"angle": 2 * np.pi}, "body.angle=6.283.* must be less than 6.283"),
        ({"radius": 0.015}, "layers of 0.015 m together leave no core within body.radius=0.015 m"),
        ({"cells": [1, 8]}, "body.cells=.* must be greater than or equal to 2"),
        ({"layers": []}, "at least one layer"),
    ],
)
def test_what_is_no_arm_is_refused_by_name(changes, says):
    with pytest.raises(InputError, match=says):
        arm(**changes)


def test_it_says_how_to_give_it_another_size():
    """Recordings and layouts know extents, not angles."""
    body = arm()
    typed = dict(part.removeprefix("body.").split("=") for part in body.resized((0.12, 0.16)).split())
    assert arm(**{name: float(value) for name, value in typed.items()}).size == pytest.approx((0.12, 0.16))

"""The reference solutions are checked against other formulas and numerical integration."""

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.special import j0, j1

from experiments.laws.references import Discs, HalfSpace, Slab, bonded_layer, waves

SOFT, HARD = Slab(0.005, 170e3, 0.499), Slab(0.010, 560e3, 0.49)


@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.45, 0.499, 0.4999])
@pytest.mark.parametrize("number", [5.0, 100.0, 3000.0])
def test_one_layer_is_the_closed_form(ratio, number):
    slab = Slab(0.01, 2e5, ratio)
    motion, stress = waves(np.array([number]), [slab], 0.0)[0, [1, 3], 0]
    assert motion == pytest.approx(bonded_layer(number, slab), rel=1e-10)
    assert stress == pytest.approx(-1, rel=1e-12)


def test_a_layer_cut_in_two_is_one_layer():
    whole, halves = [Slab(0.015, 1e5, 0.4)], [Slab(0.005, 1e5, 0.4), Slab(0.01, 1e5, 0.4)]
    numbers = np.array([10.0, 200.0])
    for depth in (0.0, 0.003, 0.009):
        ours, exact = waves(numbers, halves, depth), waves(numbers, whole, depth)
        assert ours == pytest.approx(exact, rel=1e-9, abs=1e-9 * float(np.abs(exact).max()))


def test_two_layers_integrated_step_by_step():
    """Shoot from the surface through both layers: the base does not move, and the joint says the same."""
    number = 150.0
    state = np.zeros(4)
    state[1] = waves(np.array([number]), [SOFT, HARD], 0.0)[0, 1, 0]
    state[2] = -1.0

    def fall(slab, begin):
        mu = slab.shear
        lam = slab.confined - 2 * mu

        def rate(_, y):
            along, down, normal, shear = y
            sinks = (normal + lam * number * along) / (lam + 2 * mu)
            grows = -lam * number * sinks + (lam + 2 * mu) * number**2 * along
            return [shear / mu - number * down, sinks, number * shear, grows]

        return solve_ivp(rate, (0, slab.thickness), begin, rtol=1e-11, atol=1e-18, method="LSODA").y[:, -1]

    # The motion along the wave at the surface is what leaves the base at rest.
    ends = [fall(HARD, fall(SOFT, state + move * np.eye(4)[0])) for move in (0.0, 1e-8)]
    along = -ends[0][0] / (ends[1][0] - ends[0][0]) * 1e-8
    joint = fall(SOFT, state + along * np.eye(4)[0])
    base = fall(HARD, joint)
    assert abs(base[:2]).max() < 1e-6 * state[1]
    exact = waves(np.array([number]), [SOFT, HARD], 0.005)[0, [0, 1, 3, 4], 0]
    assert joint == pytest.approx(exact, rel=1e-6)


def stress(slabs, radius, beside, depth):
    """Return the pressure at a depth beside the axis of a disc under 1 Pa."""
    table = Discs(slabs, depth, (0.8 * radius, 1.3 * radius))
    return table.forces(np.array([[0.0, beside, radius]]), np.zeros((1, 2)), 1e-5)[0, 0] / 1e-10


def test_below_a_disc_a_deep_layer_is_a_half_space():
    """Boussinesq, integrated over a disc: sigma_zz = -p (1 - z^3 / (a^2 + z^2)^1.5) on its axis."""
    for radius, depth in ((0.005, 0.002), (0.008, 0.006), (0.02, 0.01)):
        force = stress([Slab(2.0, 1e5, 0.3)], radius, 0.0, depth)
        exact = 1 - depth**3 / (radius**2 + depth**2) ** 1.5
        assert force == pytest.approx(exact, rel=1e-4)


@pytest.mark.parametrize("slabs", [[SOFT], [SOFT, HARD], [HARD, SOFT]], ids=["one", "soft", "hard"])
def test_below_a_disc_layers_are_integrated_adaptively(slabs):
    """sigma_zz at a point beside the axis: the integral of a J1(k a) J0(k r) times that of a wave."""
    radius, beside, depth = 0.006, 0.004, 0.0045

    def wave(number):
        motion = waves(np.array([number]), slabs, depth)[0, 3, 0]
        return -motion * radius * j1(number * radius) * j0(number * beside)

    exact = quad(wave, 1e-9, 40 / depth, limit=400)[0]
    assert stress(slabs, radius, beside, depth) == pytest.approx(exact, rel=1e-5)


def test_below_the_middle_of_a_square_boussinesq_is_steinbrenner():
    """sigma_zz under the corner of a rectangle (Newmark): four squares meet in the middle."""
    m = n = 0.01 / 0.007
    root = np.sqrt(m**2 + n**2 + 1)
    first = m * n * (m**2 + n**2 + 2) / (root * (m**2 + 1) * (n**2 + 1))
    corner = (first + np.arcsin(m * n / np.sqrt((m**2 + 1) * (n**2 + 1)))) / (2 * np.pi)
    stress = HalfSpace(1e5, 0.4, 0.01).under_pressure(np.array([[0, 0, 0.007]]))[1]
    assert stress[0, 0] == pytest.approx(-4 * corner, rel=1e-6)


def test_love_in_the_middle_of_a_square():
    """Love (1929): 8 a ln(1 + sqrt 2) (1 - nu^2) / (pi E) in the middle of a square of side 2 a."""
    down, along = HalfSpace(1e5, 0.4, 0.01).middle()
    assert down == pytest.approx(8 * 0.01 * np.log(1 + np.sqrt(2)) * (1 - 0.16) / (np.pi * 1e5), rel=1e-6)
    # A traction moves the surface by the same with 1 - nu + nu x^2 / r^2, whose mean over a square is 1/2.
    assert along == pytest.approx(down * (1 - 0.4 / 2) / (1 - 0.4), rel=1e-6)


@pytest.mark.parametrize("kind", ["under_pressure", "under_shear"])
def test_half_spaces_are_in_equilibrium(kind):
    """The stress on a deep wide plane carries the load, and motion and stress obey Hooke's law."""
    space = HalfSpace(1e5, 0.3, 0.01)
    part = 0 if kind == "under_pressure" else 1
    points, weights = np.polynomial.legendre.leggauss(80)
    turn = np.pi / 2 * points
    x = 0.02 * np.tan(turn)  # the whole plane
    dx = 0.02 * np.pi / 2 * weights / np.cos(turn) ** 2
    plane = np.stack([*np.meshgrid(x, x), np.full((80, 80), 0.02)], axis=-1).reshape(-1, 3)
    force = np.outer(dx, dx).ravel() @ getattr(space, kind)(plane)[1][:, part]
    assert force == pytest.approx(-4e-4, rel=1e-3)
    position, step = np.array([0.013, 0.004, 0.009]), 1e-6
    around = np.concatenate([position + step * np.eye(3), position - step * np.eye(3)])
    motion = getattr(space, kind)(around)[0]
    gradient = (motion[:3] - motion[3:]).T / (2 * step)
    lam = 2 * space.shear * 0.3 / 0.4
    zz = lam * np.trace(gradient) + 2 * space.shear * gradient[2, 2]
    xz, yz = (space.shear * (gradient[axis, 2] + gradient[2, axis]) for axis in (0, 1))
    stress = getattr(space, kind)(position[None])[1][0]
    assert stress == pytest.approx(np.array([zz, xz, yz]), rel=1e-5)

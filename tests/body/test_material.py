"""Materials: the report's numbers, and what is refused."""

import math

import pytest

from skin.body.material import MATERIALS, Material, Relaxation
from skin.errors import InputError

KSI = 6.894757e6
ECOFLEX = {"name": "EcoFlex 00-30"}


@pytest.mark.parametrize(
    ("name", "young", "poisson", "shear"),
    [("EcoFlex 00-30", 0.02466, 0.499, 0.008224), ("Dragon Skin 10 Medium", 0.08122, 0.54, 0.02637)],
)
def test_constants_are_the_reports(name, young, poisson, shear):
    material = Material.of(name)
    assert material.young == pytest.approx(young * KSI, rel=2e-4)
    assert material.poisson == poisson
    assert material.shear == pytest.approx(shear * KSI, rel=5e-4)


@pytest.mark.parametrize("name", ["ecoflex_00_30", "EcoFlex 00-30", "ECOFLEX0030"])
def test_a_name_is_read_as_people_write_it(name):
    assert Material.of(name) == MATERIALS[0]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("rubber", "unknown material rubber: known materials: EcoFlex 00-30, Dragon Skin 10 Medium"),
        ("rubber", "'name': 'rubber', 'young': 100e3, 'poisson': 0.49. in Python or .name: rubber"),
        ("EcoFlex Gel", "EcoFlex Gel has no constants of its own.*young .Pa. and poisson"),
        ({"name": "EcoFlex Gel", "young": 1e4}, "give poisson"),
        ({"name": "foam", "yuong": 1e4}, "material has no setting yuong: did you mean young[?]"),
        ({"young": 1e4, "poisson": 0.3}, "material needs name, got young, poisson"),
        (17, "material must be settings by name, got 17"),
        ({"name": "foam", "young": 0, "poisson": 0.3}, "material.young=0 must be greater than 0"),
        ({"name": "foam", "young": 1e4, "poisson": 1.0}, "material.poisson=1.0 must be less than 1"),
        ({"name": "foam", "young": 1e4, "poisson": -1}, "material.poisson=-1 must be greater than -1"),
        (ECOFLEX | {"relaxation": 0.5}, "relaxation must be settings by name, got 0.5"),
        (ECOFLEX | {"relaxation": {"time": 0.5}}, "relaxation needs strength, got time"),
        (ECOFLEX | {"relaxation": {"time": 0, "strength": 1}}, "relaxation.time=0 must be greater than 0"),
        (ECOFLEX | {"relaxation": {"time": 1, "strength": -1}}, "strength=-1 must be greater than 0"),
    ],
)
def test_what_is_no_material_is_refused_by_name(given, says):
    with pytest.raises(InputError, match=says):
        Material.of(given)


def test_a_material_relaxes_from_its_instantaneous_modulus_to_its_own():
    material = Material.of({"name": "EcoFlex 00-30", "relaxation": {"time": 0.5, "strength": 0.3}})
    assert material.relaxation == Relaxation(0.5, 0.3)
    assert material.elastic(0.0) == MATERIALS[0]
    assert material.elastic(math.inf).young == pytest.approx(1.3 * MATERIALS[0].young)
    # At the speed 1 / tau half of the branch is there: s tau / (1 + s tau) = 1/2.
    assert material.elastic(2.0).young == pytest.approx(1.15 * MATERIALS[0].young)
    assert MATERIALS[0].elastic(3.0) is MATERIALS[0]

"""Materials: the report's numbers, what is refused, and values that are off by a unit."""

import math

import pytest

from skin.body.material import MATERIALS, Material, Relaxation
from skin.body.sheet import Sheet
from skin.errors import InputError
from skin.runs.build import build_device

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
        ({"young": 1e4, "poisson": 0.3}, "material needs name, got young, poisson"),
        (17, "material must be settings by name, got 17"),
        (ECOFLEX | {"relaxation": {"time": 0.5}}, "relaxation needs strength, got time"),
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


ONE = "body.layers=[{material: {name: rubber, young: 83e3, poisson: 0.45}, thickness: 0.012}]"
SMALL = ("body.size=[0.08,0.08]", "body.cells=[4,4]", "layout=grid", "layout.rows=2", "layout.columns=2")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("body.layers.0.thickness=12", r"layers.0.thickness=12 m is not plausible: .* from 1e-05 to 0.2 m"),
        ("body.layers.1.thickness=5.0", r"body.layers.1.thickness=5 m"),
        (ONE.replace("83e3", "83"), r"0.material.young=83 Pa is not plausible: .* from 1000 to 1e\+12 Pa"),
        (ONE.replace("83e3", "0.083"), r"material.young=0.083 Pa"),
        ("body.size=[160,160]", r"body.size=160 m is not plausible: it is given in m, from 0.005 to 3 m"),
        ("body.size=[0.16,16]", r"body.size=16 m"),
        ("layout.footprint=[10,10]", r"layout.footprint=10 m is not plausible: .* from 0.0001 to 0.5 m"),
        ("touch.safe_peak=[10,90.5]", r"touch.safe_peak=10 Pa is not plausible: .* from 100 to 1e\+08 Pa"),
        ("touch.thresholds.pressure=90.5", r"touch.thresholds.pressure=90.5 Pa"),
        ("touch.thresholds.travel=1", r"touch.thresholds.travel=1 m is not"),
        ("touch.speed=[30,200]", r"touch.speed=30 m/s"),
        ("touch.window=30", r"touch.window=30 s is not plausible"),
        ("touch.press=[4,20]", r"touch.press=20 s"),
        ("touch.spare=10", r"touch.spare=10 m"),
        ("device.position_error=2", r"device.position_error=2 m"),
        ("layout.depth=5", r"depth = 5 m, on a surface of 0.16 x 0.16 m, 0.015 m thick: positions are in m"),
    ],
)
def test_a_value_off_by_a_unit_is_refused_with_the_range(configured, override, message):
    with pytest.raises(Exception, match=message) as refused:
        build_device(configured(override))
    assert isinstance(refused.value, InputError) or isinstance(refused.value.__cause__, InputError)


def test_a_class_takes_what_a_proof_needs():
    assert Sheet([1.0, 1.0], [2, 2], [{"material": "EcoFlex 00-30", "thickness": 1.0}]).thickness == 1


@pytest.mark.parametrize("simulator", ["fem", "solid"])
def test_sensors_on_the_surface_are_warned_of(configured, simulator):
    config = configured(f"simulator={simulator}", *SMALL, ONE)
    match = r"4 of 4 sensors lie on the surface.*layout.depth=0.004 simulator=solid"
    with pytest.warns(UserWarning, match=match):
        build_device(config)

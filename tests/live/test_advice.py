"""What is said of a run that should not watch a real skin."""

import pytest

from skin.runs.build import build_device, equation10_warning

PORT = ("device=serial", "device.port=/dev/ttyACM0", "device.scale=0.04")


@pytest.mark.parametrize(
    ("trained", "warned"),
    [
        (["simulator=fem"], True),
        (["simulator=fem", "simulator.reading=interface"], False),
        (["simulator=solid"], False),
    ],
)
def test_a_run_on_equation_10_is_announced_at_a_port_only(configured, trained, warned):
    stored = configured(*trained)
    said = equation10_warning(stored, build_device(configured(*PORT)))
    assert (said is not None) == warned
    assert said is None or "simulator=solid" in said
    assert equation10_warning(stored, build_device(configured("simulator=naive"))) is None

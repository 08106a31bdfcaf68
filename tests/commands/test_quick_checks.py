"""What is wrong in a configuration is refused before a run is loaded."""

import pytest
from hydra import compose, initialize_config_dir

from skin.commands._command import check_quickly
from skin.core.files import CONF
from skin.errors import InputError
from skin.runs.configuration import validate_config


def check(*overrides, name="evaluate"):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose(name, list(overrides))
        check_quickly(validate_config(config), config.get("run"), overrides)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["device=serial", "device.port=/dev/none"], "no port /dev/none"),
        (["device=serial", "device.port=./skin-port"], "no port ./skin-port"),
        (["touch.rate=-1"], r"touch\.rate=-1 must be greater than 0"),
        (["device.noise=-1"], r"device\.noise=-1"),
        (["body.size=[160,160]"], r"body\.size=160 m is not plausible"),
        (["layout=grid", "layout.rows=0"], r"layout\.rows=0"),
    ],
)
def test_a_wrong_setting_is_refused(overrides, message):
    with pytest.raises(InputError, match=message):
        check(*overrides)


@pytest.mark.parametrize("name", ["train", "live", "export", "adapt", "record", "listen", "emulate", "study"])
def test_the_defaults_of_every_command_are_accepted(name):
    check(name=name)


def test_ports_that_cannot_be_checked_are_left_to_the_device():
    for port in ("COM3", "rfc2217://host:1", "socket://192.0.2.1:7", "null"):
        check("device=serial", f"device.port={port}")

"""Show the predictions of a pretrained model for an emulated skin on a web page.

    skin demo

Prints the address of the page. Ctrl-C stops. The settings are those of skin live.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from omegaconf import DictConfig, OmegaConf

from skin.command import command
from skin.commands.live import show
from skin.config import overrides


@command("demo")
def main(config: DictConfig) -> None:
    """Emulate the skin of a run at a local port, and watch it as ``skin live`` does."""
    with _emulated(config) as port:
        given = ["device=serial", *(f"device.{name}={value}" for name, value in port.items()), *overrides()]
        merged = OmegaConf.merge(config, {"device": port})
        assert isinstance(merged, DictConfig)
        show(merged, given, own_mechanics=True)


@contextmanager
def _emulated(config: DictConfig) -> Iterator[dict[str, str | float]]:
    """Emulate the skin of a run, without the imperfections of its training; yield settings of its port."""
    from threading import Thread

    from hydra import compose

    from skin.build import build_device
    from skin.console import quiet
    from skin.hardware.emulator.emulator import Emulator, EmulatorSettings, Faults, open_port
    from skin.run_overrides import apply_overrides
    from skin.stored_run import find_run, load_configuration
    from skin.tracking import Store

    quiet()
    store = Store.existing(config.tracking)
    stored = load_configuration(store, find_run(store, config.run), config.trust)
    device = build_device(apply_overrides(stored, compose("train"), ["device=simulated"]))
    port = open_port("tcp:0", None)
    emulator = Emulator(device.simulated("a skin is emulated"), port, EmulatorSettings(), Faults())
    thread = Thread(target=emulator.run, name="skin-emulator", daemon=True)
    thread.start()
    try:
        yield {"port": port.address, "scale": emulator.converter.scale}
    finally:
        emulator.stop()
        thread.join()
        port.unplug()

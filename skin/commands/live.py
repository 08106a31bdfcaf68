"""Show the predictions of a trained run for a skin in real time.

    skin live device=serial device.port=/dev/ttyACM0
    skin live run=skin.onnx device=serial device.port=/dev/ttyACM0
    skin live web=true
    skin live demo=true

run=latest names the run, or a file of skin export, which starts faster; web=true also serves a page. Without
device= the simulator of the run is used: no hardware is needed. demo=true emulates the skin of a pretrained
model at a port of this machine and serves the page. Ctrl-C stops.
"""

import gc
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from hydra import compose
from omegaconf import OmegaConf

from skin.commands._command import command
from skin.errors import InputError
from skin.runs.configuration import Config, overrides, validate_config

if TYPE_CHECKING:
    from skin.live.contacts import LiveContacts
    from skin.live.engine_builder import LiveSettings, LiveSetup
    from skin.live.loop import Display


_DEMO = (
    "run=any_skin",
    "web=true",
    "touch=fingertips",
    "touch.force=2",
    "layout=grid",
    "layout.rows=6",
    "layout.columns=6",
    "body.layers=[{material: Dragon Skin 10 Medium, thickness: 0.01}, "
    "{material: EcoFlex 00-30, thickness: 0.01}]",
)
"""Settings of a demonstration, unless others are given: fingertips, on a skin that tells them apart."""

Say = Callable[[str], None]
"""Called with each message for the user."""


@command("live")
def main(
    config: Config, run: str, demo: bool, web: bool, seconds: float | None, live: dict[str, Any]
) -> None:
    """Load a run or an exported model, open the skin, and show verdicts until the command is ended."""
    if demo:
        with emulated_skin(overrides()) as words:
            composed = compose("live", words)
            plain: Any = OmegaConf.to_container(composed)
            run, web, seconds, live = (plain[name] for name in ("run", "web", "seconds", "live"))
            show(validate_config(composed), words, run, web, seconds, live, own_mechanics=True)
    else:
        show(config, overrides(), run, web, seconds, live)


@contextmanager
def emulated_skin(words: Sequence[str]) -> Iterator[list[str]]:
    """Emulate the skin of a run, without the imperfections of its training, at a port of this machine.

    Args:
        words: overrides of the command line.

    Yields:
        The overrides of a live view of this skin.

    Raises:
        InputError: a device is given, or the run cannot be emulated.
    """
    from threading import Thread

    from skin.core.messages import quiet
    from skin.runs.build import build_device
    from skin.runs.run import FinishedRun
    from skin.wire.emulator import Emulator, EmulatorSettings, Faults, open_port

    quiet()
    if devices := [word for word in words if word.startswith("device=")]:
        raise InputError(f"demo=true emulates a skin at a port: leave out {devices[0]}, or demo=true")
    words, touched = _demo_overrides(words)
    composed = compose("live", words)
    run = FinishedRun.named(composed.run, validate_config(composed))
    device = build_device(run.configured(touched))
    port = open_port("tcp:0", None)
    emulator = Emulator(device.simulated("a skin is emulated"), port, EmulatorSettings(), Faults())
    thread = Thread(target=emulator.run, name="skin-emulator", daemon=True)
    thread.start()
    try:
        settings = {"port": port.address, "scale": emulator.converter.scale}
        yield [*words, *(f"device.{name}={value}" for name, value in settings.items())]
    finally:
        emulator.stop()
        thread.join()
        port.unplug()


def _demo_overrides(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the overrides of the live view of a demonstration, and those of the skin that is emulated."""
    skin, groups = {"body", "layout", "simulator"}, {_group(word) for word in words}
    if groups & {"run", *skin}:
        groups |= skin  # it is another one
    words = [*(word for word in _DEMO if _group(word) not in groups), *words]
    touched = [word for word in words if _group(word) in {"touch", *skin}]
    return ["device=serial", *(word for word in words if _group(word) != "touch")], [
        "device=simulated",
        *touched,
    ]


def _group(word: str) -> str:
    return re.split(r"[.=]", word, maxsplit=1)[0]


def show(
    config: Config,
    changes: Sequence[str],
    run: str,
    web: bool,
    seconds: float | None,
    settings: dict[str, Any],
    own_mechanics: bool = False,
) -> None:
    """Show the predictions of a run for a skin until the command is ended.

    Args:
        config: of the command.
        changes: settings that replace those of the run, as overrides; ``config`` has their values.
        run, web, seconds, settings: as :func:`main` takes them; ``settings`` are those under ``live:``.
        own_mechanics: the skin at the port is emulated with the simulator of the run.
    """
    from rich.console import Console

    from skin.core.interrupt import ends_on_signal
    from skin.live.contacts import LiveContacts
    from skin.live.engine_builder import LiveSettings
    from skin.live.loop import LiveLoop

    live, say = LiveSettings.of(settings), Console(stderr=True, highlight=False).print
    try:
        with ExitStack() as opened:
            opened.enter_context(ends_on_signal())
            setup = _load(run, config, live, say, changes, opened, own_mechanics)
            contacts = _start_contacts(setup, say) if live.contacts else LiveContacts("live.contacts=false")
            opened.callback(contacts.close)
            display = _open_views(setup, contacts, web, live, say, opened)
            watched = setup.watch(live, say)
            if live.verdicts is None:
                from skin.live.terminal import show_in_terminal

                opened.enter_context(show_in_terminal(display, Console()))
            source, engine = watched.source, watched.engine
            check = partial(watched.check, live.selftest, say, display.add_note)
            session = LiveLoop(source.skin, source.tare, engine, display, check)
            opened.callback(lambda: say(f"{session.verdicts} verdicts, {session.line}"))
            # A search for garbage among all that is loaded would stop the loop for 0.3 s, every few seconds.
            gc.collect()
            gc.freeze()
            session.run(seconds)
    except KeyboardInterrupt:
        print("ended", file=sys.stderr)


def _load(
    run: str,
    config: Config,
    live: "LiveSettings",
    say: Say,
    changes: Sequence[str],
    opened: ExitStack,
    own_mechanics: bool,
) -> "LiveSetup":
    """Return the model and its device; the arguments are those of ``watch_run``."""
    from skin.core.messages import quiet
    from skin.live.engine_builder import watch_exported, watch_run
    from skin.runs.model import check_overrides

    if not run.endswith(".onnx"):
        quiet()
        return watch_run(run, config, live, say, changes, opened, own_mechanics)
    check_overrides(run, changes)
    return watch_exported(run, config.device, say, opened)


def _start_contacts(setup: "LiveSetup", say: Say) -> "LiveContacts":
    """Return estimates of contacts, whose process is started if the mechanics are known."""
    from skin.live.contacts import LiveContacts

    contacts = LiveContacts()
    try:
        contacts.start(setup.mechanics(), lambda: setup.port is not None and setup.port.raw_range.whole)
    except InputError as error:
        contacts.explain(str(error))
        say(f"no contacts: {error}")
    return contacts


def _open_views(
    setup: "LiveSetup",
    contacts: "LiveContacts",
    web: bool,
    live: "LiveSettings",
    say: Say,
    opened: ExitStack,
) -> "Display":
    """Open what shows the verdicts but the terminal; return what they show."""
    from skin.live.loop import Display, DisplayInfo, watch_age
    from skin.live.verdicts import log_alarms, print_verdicts

    model = setup.model
    span = model.window / model.rate
    info = DisplayInfo(model.title, setup.name, model.positions, model.size, live.top, span)
    display = Display(info, contacts, live.patience.calm)
    display.set_verdict(None, monotonic(), "the threshold of the alarm is being chosen")
    if live.log is not None:
        opened.enter_context(log_alarms(display, Path(live.log).expanduser()))
    if live.verdicts is not None:
        opened.enter_context(print_verdicts(display))
    if web:
        from skin.live.web import serve_page

        say(f"page: {opened.enter_context(serve_page(display, live.web_port))}")
    opened.enter_context(watch_age(display))
    return display

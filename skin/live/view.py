"""The whole live view of ``skin live``, and the emulated skin of its demonstration."""

import gc
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from threading import Thread
from time import monotonic

from rich.console import Console

from skin.core.interrupt import ends_on_signal
from skin.core.messages import quiet
from skin.errors import InputError
from skin.live.contacts import LiveContacts
from skin.live.engine_builder import LiveSettings, LiveSetup, watch_exported, watch_run
from skin.live.loop import Display, DisplayInfo, LiveLoop, watch_age
from skin.live.terminal import show_in_terminal
from skin.live.verdicts import log_alarms, print_verdicts
from skin.runs.configuration import Config
from skin.runs.model import check_overrides

_say = Console(stderr=True, highlight=False).print


@contextmanager
def emulated_skin(run: str, config: Config, overrides: Sequence[str]) -> Iterator[list[str]]:
    """Emulate the skin of a run, without the imperfections of its training, at a port of this machine.

    Args:
        run: name of a run that was trained on a simulated skin.
        config: of the command.
        overrides: settings that replace those of the run.

    Yields:
        The settings of a device at this port, as overrides.

    Raises:
        InputError: there is no such run, or its skin cannot be emulated.
    """
    from skin.runs.build import build_device
    from skin.runs.run import find_run
    from skin.wire.emulator import Emulator, EmulatorSettings, Faults, open_port

    quiet()
    emulated = find_run(config.tracking, run, config.trust).configured(["device=simulated", *overrides])
    device = build_device(emulated).simulated("a skin is emulated")
    port = open_port("tcp:0", None)
    emulator = Emulator(device, port, EmulatorSettings(), Faults())
    thread = Thread(target=emulator.run, name="skin-emulator", daemon=True)
    thread.start()
    try:
        yield ["device=serial", f"device.port={port.address}", f"device.scale={emulator.converter.scale}"]
    finally:
        emulator.stop()
        thread.join()
        port.unplug()


def show(
    run: str,
    config: Config,
    overrides: Sequence[str],
    live: LiveSettings,
    web: bool,
    seconds: float | None,
    own_mechanics: bool = False,
) -> None:
    """Show the predictions of a run for a skin until the command is ended.

    Args:
        run: name of a run, or an ONNX file.
        config: of the command.
        overrides: settings that replace those of the run; ``config`` has their values.
        live: settings of the view.
        web: whether to serve a page, too.
        seconds: duration, s; None: until the command is ended.
        own_mechanics: the skin at the port is emulated with the simulator of the run.

    Raises:
        InputError: the model, the device or the settings cannot be used.
    """
    try:
        with ExitStack() as opened:
            opened.enter_context(ends_on_signal())
            if run.endswith(".onnx"):
                check_overrides(run, overrides)
                setup = watch_exported(run, config.device, _say, opened)
            else:
                quiet()
                setup = watch_run(run, config, live, _say, overrides, opened, own_mechanics)
            display = _open_views(setup, live, web, opened)
            watched = setup.watch(live, _say)
            if live.verdicts is None:
                opened.enter_context(show_in_terminal(display, Console()))
            source, engine = watched.source, watched.engine
            check = partial(watched.check, live.selftest, _say, display.add_note)
            loop = LiveLoop(source.skin, source.tare, engine, display, check)
            opened.callback(lambda: _say(f"{loop.verdicts} verdicts, {loop.line}"))
            # A search for garbage among all that is loaded would stop the loop for 0.3 s, every few seconds.
            gc.collect()
            gc.freeze()
            loop.run(seconds)
    except KeyboardInterrupt:
        print("ended", file=sys.stderr)


def _open_views(setup: LiveSetup, live: LiveSettings, web: bool, opened: ExitStack) -> Display:
    """Start the estimates of contacts and all views but the terminal; return what they show."""
    contacts = LiveContacts("" if live.contacts else "live.contacts=false")
    opened.callback(contacts.close)
    try:
        if live.contacts:
            contacts.start(setup.mechanics(), lambda: setup.port is not None and setup.port.raw_range.whole)
    except InputError as error:
        contacts.explain(str(error))
        _say(f"no contacts: {error}")
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

        _say(f"page: {opened.enter_context(serve_page(display, live.web_port))}")
    opened.enter_context(watch_age(display))
    return display

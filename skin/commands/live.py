"""Show the predictions of a trained run for a skin in real time.

    skin live device=serial device.port=/dev/ttyACM0
    skin live run=skin.onnx device=serial device.port=/dev/ttyACM0
    skin live web=true

run=latest names the run, or a file of skin export, which starts faster; web=true also serves a page. Without
device= the simulator of the run is used: no hardware is needed. Ctrl-C stops.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from skin.command import command
from skin.config import overrides, plain

if TYPE_CHECKING:
    from skin.hardware.live.live_settings import LiveSettings
    from skin.hardware.live.loop import Display


@command("live")
def main(config: DictConfig) -> None:
    """Load a run or an exported model, open the skin, and show verdicts until the command is ended."""
    show(config, overrides())


def show(config: DictConfig, given: Sequence[str], own_mechanics: bool = False) -> None:
    """Show the predictions of a run for a skin until the command is ended.

    Args:
        config: of the command.
        given: settings that replace those of the run, as overrides; ``config`` has their values.
        own_mechanics: the skin at the port is emulated with the simulator of the run.
    """
    from skin.hardware.live.live_settings import LiveSettings

    live = LiveSettings.of(plain(config)["live"])
    try:
        _watch(config, live, given, own_mechanics)
    except KeyboardInterrupt:
        print("ended", file=sys.stderr)


def _watch(config: DictConfig, live: "LiveSettings", given: Sequence[str], own_mechanics: bool) -> None:
    from rich.console import Console

    from skin.hardware.live.loop import Display, DisplayInfo, LiveLoop
    from skin.hardware.live.watched import check_settings
    from skin.interrupt import ends_on_signal

    messages = Console(stderr=True, highlight=False)
    if str(config.run).endswith(".onnx"):
        from skin.exported.identity import check_overrides
        from skin.hardware.live.watched import watch_model

        check_overrides(config.run, config, given)
        device = plain(config)["device"]
        watch = partial(watch_model, config.run, device, live, messages.print)
    else:
        from skin.console import quiet
        from skin.hardware.live.trained_run import watch_run

        quiet()
        watch = partial(watch_run, config, live, messages.print, given, own_mechanics=own_mechanics)
    with ExitStack() as open_:
        open_.enter_context(ends_on_signal())
        watched = watch(opened=open_)
        source = watched.source
        display = Display(
            DisplayInfo(watched.title, source.name, watched.positions, watched.size, live.top, watched.span)
        )
        for text in _views(display, config, live, open_):
            messages.print(text)
        before = partial(check_settings, watched, live.selftest, messages.print)
        session = LiveLoop(source.skin, source.tare, watched.settings.build(), display, before)
        open_.callback(lambda: messages.print(f"{session.verdicts} verdicts, {session.line}"))
        session.run(config.seconds)


def _views(display: "Display", config: DictConfig, live: "LiveSettings", open_: ExitStack) -> Iterator[str]:
    """Open what shows the verdicts; yield messages."""
    if live.log is not None:
        from skin.hardware.live.verdict_stream import log_alarms

        open_.enter_context(log_alarms(display, Path(live.log).expanduser()))
    if config.web:
        from skin.hardware.live.web import serve_page

        yield f"page: {open_.enter_context(serve_page(display, live.web_port))}"
    if live.verdicts is not None:
        from skin.hardware.live.verdict_stream import stream_verdicts

        yield f"verdicts: {open_.enter_context(stream_verdicts(display, live.verdicts))}"
    if live.verdicts != "stdout":
        from rich.console import Console

        from skin.hardware.live.terminal import show_in_terminal

        open_.enter_context(show_in_terminal(display, Console()))

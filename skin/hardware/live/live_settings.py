"""The settings of ``skin live``."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le

from skin.hardware.live.engine import DebounceSettings
from skin.settings import configured


@dataclass(frozen=True)
class LiveSettings:
    """Settings under ``live:`` (``conf/live.yaml``).

    Attributes:
        web_port: port of the page; 0: any free one.
        top: upper end of the colour scale, N.
        touch: contact threshold, N above the baseline; None: that of the run.
        drift: N in ten minutes that the baseline may follow without touch.
        verdicts: where JSON lines go: ``stdout``, or a TCP port, 0: any free one; None: nowhere.
        log: file to which alarms are appended; None: no log.
        selftest: whether simulated dangerous touches must raise the alarm at the start.
        patience: settings of debouncing.
    """

    web_port: Annotated[int, Ge(0), Le(65535)]
    top: Annotated[float, Gt(0)]
    touch: Annotated[float, Gt(0)] | None
    drift: Annotated[float, Ge(0)]
    verdicts: Literal["stdout"] | Annotated[int, Ge(0), Le(65535)] | None
    log: str | None
    selftest: bool
    patience: DebounceSettings

    @classmethod
    def of(cls, live: Mapping[str, Any]) -> "LiveSettings":
        """Return checked settings from plain containers.

        Raises:
            InputError: a setting is unknown or invalid.
        """
        patience = configured(DebounceSettings, live["patience"], "live.patience")
        return configured(cls, {**live, "patience": patience}, "live")

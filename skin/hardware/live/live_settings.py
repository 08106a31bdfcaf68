"""The settings of ``skin live``."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le

from skin.hardware.live.verdict import DebounceSettings
from skin.settings import configured


@dataclass(frozen=True)
class LiveSettings:
    """What ``live:`` holds (``conf/live.yaml``).

    Attributes:
        web_port: of the page; 0 takes a free one.
        top: N at the end of the colour scale.
        touch: N above baseline that are a touch; None: as the run learned it.
        drift: N in ten minutes that the baseline may follow while nothing touches.
        patience: how long answers must hold.
    """

    web_port: Annotated[int, Ge(0), Le(65535)]
    top: Annotated[float, Gt(0)]
    touch: Annotated[float, Gt(0)] | None
    drift: Annotated[float, Ge(0)]
    patience: DebounceSettings

    @classmethod
    def of(cls, live: Mapping[str, Any]) -> "LiveSettings":
        """Return the settings in plain containers.

        Raises:
            InputError: one that is unknown or cannot be used.
        """
        patience = configured(DebounceSettings, live["patience"], "live.patience")
        return configured(cls, {**live, "patience": patience}, "live")

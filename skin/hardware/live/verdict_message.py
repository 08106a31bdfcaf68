"""Verdicts as JSON, for other programs."""

from datetime import UTC, datetime, timedelta
from math import isfinite
from time import monotonic
from typing import Any

from skin.hardware.live.verdict import Verdict

SCHEMA = 1
"""Version of the messages. A field may be added without a new version; a reader ignores unknown ones."""


def verdict_message(verdict: Verdict | None, reason: str, alarm: bool) -> dict[str, Any]:
    """Return a verdict, or the reason why there is none, as JSON data.

    Args:
        verdict: the present one; None if there is none.
        reason: why there is none.
        alarm: an alarm that continues without a verdict.

    Returns:
        The fields of ``docs/export.md`` but ``number`` and ``event``.
    """
    if verdict is None:
        shared = {"schema": SCHEMA, "stale": True, "reason": reason, "state": "unknown"}
        return shared | {"time": _utc(0.0), "alarm": alarm}
    shared = {"schema": SCHEMA, "stale": False, "reason": verdict.reason, "state": verdict.state}
    return shared | {
        "time": _utc(monotonic() - verdict.t_host),
        "alarm": verdict.dangerous,
        "device_time": verdict.t,
        "touched": verdict.touched,
        "labels": verdict.labels,
        # JSON has no NaN.
        "probabilities": {
            name: round(value, 6) if isfinite(value) else None for name, value in verdict.chances.items()
        },
        "contact": verdict.contact,
        "gap": verdict.gap,
        "masked": list(verdict.masked),
        "unknown": list(verdict.unknown),
    }


def _utc(ago: float) -> str:
    """Return the time some seconds ago, ISO 8601 in UTC."""
    moment = datetime.now(UTC) - timedelta(seconds=ago)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")

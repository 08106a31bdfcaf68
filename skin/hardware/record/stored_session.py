"""The content of a session on disk."""

from dataclasses import dataclass, field
from typing import Any

from skin.wire.conversion import UnitConversion
from skin.wire.segmentation import RecordedGesture

_NAMED = 5  # lines or gestures, in a sentence


@dataclass
class StoredSession:
    """Content of a session.

    Attributes:
        about: metadata in the JSON file beside it.
        gestures: complete gestures by number, each with its unit conversion; the last one of a number counts.
        frames: number of frames.
        end: time of the last frame, s.
        damaged: numbers of the lines that cannot be read; the header is line 1.
        left_out: number of a gesture -> reason why it cannot be used.
    """

    about: dict[str, Any]
    gestures: dict[int, tuple[RecordedGesture, UnitConversion]] = field(default_factory=dict)
    frames: int = 0
    end: float = -1.0
    damaged: list[int] = field(default_factory=list)
    left_out: dict[int, str] = field(default_factory=dict)

    @property
    def warnings(self) -> list[str]:
        """Warnings about damaged lines and omitted gestures."""
        warnings = []
        if count := len(self.damaged):
            warnings.append(f"{count} damaged line{'s' * (count > 1)} skipped: {_some(self.damaged)}")
        for reason in dict.fromkeys(self.left_out.values()):
            numbers = [number for number, why in self.left_out.items() if why == reason]
            warnings.append(f"gesture {_some(numbers)} left out: {reason}")
        return warnings


def _some(numbers: list[int]) -> str:
    more = f" and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else ""
    return ", ".join(map(str, numbers[:_NAMED])) + more

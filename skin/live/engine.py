"""From frames to verdicts, without any input or output."""

import numpy as np
import torch
from torch import Tensor

from skin.evaluation.report import Answers
from skin.labels import Task
from skin.live.verdict import Debounce, Patience, Verdict
from skin.live.window import Seen, Window
from skin.port.frame import Frame
from skin.recording import Touches
from skin.signal.gate import Gate

__all__ = ["Engine"]


class Engine:
    """Says at every frame what the window that ends there shows.

    Args:
        learner: trained.
        task: what its labels mean.
        positions: (S, 3), m.
        frames: T, frames of its window.
        rate: that it was trained at, Hz.
        gate: tells which windows are touched at all.
        patience: how long answers must hold.
    """

    def __init__(
        self,
        learner: Answers,
        task: Task,
        positions: Tensor,
        frames: int,
        rate: float,
        gate: Gate,
        patience: Patience | None = None,
    ) -> None:
        self.window = Window(frames, rate, len(positions))
        self.task = task
        self._learner, self._positions, self._gate = learner, positions, gate
        self._patience = patience or Patience()
        self._above = 0.5 if self._patience.above is None else self._patience.above
        self._segment: int | None = None
        self._restart()

    def _restart(self) -> None:
        patience = self._patience

        def slow() -> Debounce:
            return Debounce(patience.label, patience.label)

        self._touch = slow()
        self._labels = {name: slow() for name in self.task.gated}
        self._labels |= {"dangerous": Debounce(patience.alarm, patience.calm)}

    def add(self, frame: Frame) -> None:
        """Let the window slide without asking: for frames that have waited while another was classified."""
        if frame.segment != self._segment:
            self._segment = frame.segment
            self._restart()
        self.window.add(frame)

    def push(self, frame: Frame) -> Verdict | None:
        """Return what the window that ends with this frame is said to show; None while it is not full.

        Args:
            frame: values in N above the baseline.

        Raises:
            InputError: the stream is slower than the model's rate.
        """
        self.add(frame)
        seen = self.window.read()
        return None if seen is None else self._verdict(seen, frame)

    @torch.inference_mode()
    def _verdict(self, seen: Seen, frame: Frame) -> Verdict:
        readings, valid = torch.from_numpy(seen.readings)[None], torch.from_numpy(seen.valid)[None]
        touches = Touches(readings, valid, self._positions, None, self.window.rate)
        answers = self._learner.probabilities(touches)
        touched = bool(self._gate(touches, answers)[0])
        chances = dict(zip(self.task.names, answers[0].tolist(), strict=True))
        masked = tuple(np.flatnonzero(~seen.valid.any(axis=0)).tolist())
        period = self.window.period

        def settled(debounce: Debounce, answer: bool) -> bool:
            return debounce(answer, frame.t, period)

        dangerous = settled(
            self._labels["dangerous"], touched and chances.get("dangerous", 0.0) > self._above
        )
        # An alarm does not wait until the touch is settled.
        shown = settled(self._touch, touched) or dangerous
        answer = self._answers(chances)
        said = {
            name: settled(self._labels[name], answer[name]) for name in self.task.gated if name != "dangerous"
        }
        if "dangerous" in self.task.names:
            said["dangerous"] = dangerous
        return Verdict(
            frame.t, frame.t_host, chances, shown, said if shown else {}, dangerous, seen.gap, masked
        )

    def _answers(self, chances: dict[str, float]) -> dict[str, bool]:
        """Return which labels hold in this window: the likeliest one where they exclude each other."""
        if self.task.kind == "exclusive":
            best = max(chances, key=chances.__getitem__)
            return {name: name == best for name in chances}
        return {name: chance > 0.5 for name, chance in chances.items()}

"""A command shows its progress and the time left."""

import io

import pytest
from rich.console import Console

from skin.core import progress
from skin.core.progress import Steps


@pytest.mark.parametrize("terminal", [True, False])
def test_a_bar_of_steps_is_shown_on_a_terminal_only(monkeypatch, terminal):
    file = io.StringIO()
    monkeypatch.setattr(progress, "CONSOLE", Console(file=file, force_terminal=terminal, width=80))
    with Steps({"load": 10, "evaluate": 30}) as steps:
        steps.begin("evaluate")
        steps.refresh()
        assert steps.tasks[0].percentage == 25
        steps.report(0.5)
        assert steps.tasks[0].percentage == 62.5
        with Steps({"choose": 1}) as inner:
            inner.refresh()
    shown = file.getvalue()
    assert all((word in shown) == terminal for word in ("evaluate", "25%", "choose"))
    assert terminal or not shown

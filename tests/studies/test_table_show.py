"""What a person sees at the terminal is whole."""

import io

from rich.console import Console

from studies.table import COLUMNS, LABELS, show


def test_no_number_is_cut_on_a_narrow_terminal():
    line = dict.fromkeys(COLUMNS, "0.1234") | {"row": "temporal_graph", "simulator": "naive", "failed": "0"}
    lines = [line | {"label": label, "ours_sd": "0.0123", "report": "0.85"} for label in LABELS]
    seen = io.StringIO()
    show(lines, "title", Console(file=seen, width=40))
    text = seen.getvalue()
    assert "…" not in text
    assert "12.3 ± 1.2 (85.0)" in text
    assert all(head in text for head in ("overall", "recall", "false", "dev.", "lay."))
    # A temporal_graph of one seed, with the report's number, fits 80 columns.
    line |= {"ours_sd": ""}
    seen = io.StringIO()
    show([line | {"label": label} for label in LABELS], "title", Console(file=seen, width=40))
    assert max(map(len, seen.getvalue().splitlines())) <= 80

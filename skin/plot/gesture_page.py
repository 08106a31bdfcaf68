"""Gestures of a session beside their simulation, as a page and a picture (report, figures 11 and 12)."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from skin.plot.figures import COLOURS, save_figure
from skin.plot.gesture_comparison import Gestures
from skin.plot.press_comparison import Verdicts, agreement
from skin.wire.segmentation import label_text


def gestures_markdown(found: Gestures, verdicts: Verdicts | None, about: str) -> str:
    """Return a page in Markdown.

    Args:
        found: the gestures.
        verdicts: of a run; None without one.
        about: a sentence on where this came from.
    """
    pairs, same = found.pairs, found.same
    ratios = [pair.slope if same else pair.peaks[1] / pair.peaks[0] for pair in pairs]
    low, middle, high = np.percentile(ratios, [25, 50, 75])
    kind = "readings" if same else "largest readings"
    lines = [
        "# The same gestures, simulated and recorded"
        if same
        else "# Gestures of the same labels, simulated and recorded"
    ]
    lines += ["", about, "", "![force and reading](compare.png)", "", f"- gestures: {len(pairs)}"]
    lines.append(
        f"- gain ratio of {kind} (recorded over simulated), median: {middle:.3f}, middle half {low:.3f} to "
        f"{high:.3f}"
    )
    if same:
        rmse = np.sqrt(np.mean([pair.rmse**2 for pair in pairs]))
        shares = [np.median([pair.peaks[side] / pair.applied.max() for pair in pairs]) for side in (0, 1)]
        lines.append(f"- RMSE of readings: {rmse:.3f} N")
        lines.append(
            f"- largest reading per applied force: {shares[0]:.1%} simulated, {shares[1]:.1%} recorded "
            "(the report's skin: about 5 %)"
        )
    else:
        lines.append("- what a person did is known by its labels only, so frames are not compared one by one")
    lines += agreement(verdicts, "gestures")
    lines += [
        "",
        "| gesture | sensor | force, N | simulated, N | recorded, N | ratio | RMSE, N |",
        "|---" * 7 + "|",
    ]
    for pair, ratio in zip(pairs, ratios, strict=True):
        rmse = f"{pair.rmse:.3f}" if same else ""
        lines.append(
            f"| {pair.number}: {label_text(pair.labels)} | {pair.sensor} | {pair.applied.max():.1f} | "
            f"{pair.peaks[0]:.2f} | {pair.peaks[1]:.2f} | {ratio:.3f} | {rmse} |"
        )
    return "\n".join(lines) + "\n"


def plot_gestures(found: Gestures, shown: int, path: Path) -> Path:
    """Draw applied force and reading, simulated above, recorded below, for the strongest gestures."""
    strongest = sorted(found.pairs, key=lambda pair: -pair.peaks[0])[:shown]
    drawn = Figure(figsize=(3.6 * len(strongest), 5.4), layout="constrained")
    axes = drawn.subplots(2, len(strongest), squeeze=False, sharex="col")
    for column, pair in enumerate(strongest):
        time = np.arange(len(pair.applied)) / found.rate
        strongest_there = int(np.where(pair.valid, pair.recorded, -np.inf).max(axis=0).argmax())
        sensors = pair.sensor, pair.sensor if found.same else strongest_there
        for row, name in enumerate(("simulated", "recorded")):
            axis, values = axes[row, column], getattr(pair, name)[:, sensors[row]]
            if row == 0 or found.same:
                axis.plot(time, pair.applied, color=COLOURS[0])
                axis.set_ylabel("applied force, N", color=COLOURS[0])
            else:
                axis.set_yticks([])
            twin = axis.twinx()
            twin.plot(time, np.where(pair.valid[:, sensors[row]], values, np.nan), ".-", color=COLOURS[4])
            twin.set_ylabel("reading, N", color=COLOURS[4])
            twin.set_ylim(-0.05 * max(pair.peaks), 1.1 * max(pair.peaks))
            axis.set_title(f"{name}, gesture {pair.number}, sensor {sensors[row]}", fontsize=9)
        axes[1, column].set_xlabel("time, s")
    return save_figure(drawn, path)

"""Animate a simulated or recorded touch as GIF, or draw its strongest frame as PNG.

    skin animate out=x.gif labels=[big,dynamic,press] shape=hand seed=3
    skin animate out=x.png device=recording device.path=touches.parquet index=5

Without device= the touch is simulated.
"""

from skin.commands._command import command, output
from skin.runs.configuration import Config


@command("animate")
def main(
    config: Config,
    out: str | None,
    view: str,
    labels: list[str] | None,
    shape: str | None,
    index: int | None,
) -> None:
    """Write a GIF or PNG of a simulated or recorded touch."""
    path = output(out, "touch.gif", ".gif", ".png")

    from skin.plot.animation import read_scene, simulate_scene, still, write_animation
    from skin.runs.build import build_device

    device = build_device(config)
    if device.simulation is None:
        scene = read_scene(device, index or 0)
    else:
        scene = simulate_scene(device.simulation, labels, shape, config.seed, view == "skin3d")
    (still if path.suffix == ".png" else write_animation)(scene, view, path)
    print(f"{path}: {scene.title}, {len(scene.readings)} frames at {scene.rate:g} Hz")

"""Convert recordings of others, such as CSV files and spreadsheets, to a recording; or a session to a table.

    skin convert from=map.yaml out=x.parquet
    skin convert reader=package.function path=FOLDER out=x.parquet
    skin convert from=x.parquet out=FOLDER
    skin convert from=session out=x.csv

A mapping file says what the columns are; a Python function reads everything else (docs/recordings.md).
device=recording device.path=x.parquet trains on the result. out=FOLDER is a set of LeRobot, which from=FOLDER
reads; out=x.mcap is for Foxglove and PlotJuggler. The skin of the configuration matters only for a mapping
with positions: layout, and for a set of LeRobot without positions if layout= is given. The last form writes
time, number, raw values and gesture of the frames of a session (skin record) for a spreadsheet.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from skin.commands._command import command, output
from skin.core.files import write
from skin.errors import InputError
from skin.runs.configuration import Config, overrides


@command("convert")
def main(
    config: Config,
    from_: str | None,
    reader: str | None,
    options: Mapping[str, Any] | None,
    path: str | None,
    out: str | None,
) -> None:
    """Read the files of a mapping or by a function, a recording or a session, and write one file or set."""
    if (from_ is None) == (reader is None):
        raise InputError("skin convert needs from= or reader=, and out=, as in from=map.yaml out=x.parquet")
    source = Path(from_ or "map.yaml").expanduser()
    if (source / "about.json").is_file():
        from skin.calibration.bench import load_table

        target, (table, _) = output(out, "x.csv", ".csv"), load_table(source, "session")
        print(f"{write(table.to_csv(index=False), target)}: {len(table)} frames")
        return
    file = output(out, "x.parquet", ".parquet", ".csv", ".mcap", "")

    from skin.device.conversion import convert_files, read_by_function, summarise_conversion
    from skin.device.files import write_recording
    from skin.device.formats import read_format
    from skin.runs.build import build_skin

    lerobot = (source / "meta" / "info.json").is_file()
    if lerobot or source.suffix == ".parquet":
        reader = "skin.robot.recordings.read_lerobot" if lerobot else "skin.device.files.read_recording"
        path = str(source)
    mapping = None if reader else read_format(str(from_))
    if path is None and (reader or source.suffix not in (".yaml", ".yml")):
        raise InputError(
            f"{f'reader={reader}' if reader else f'from={from_}'} needs path=FOLDER, where the recordings are"
        )
    laid = lerobot and any(word.startswith(("layout=", "layout.")) for word in overrides())
    skin = build_skin(config) if laid or (mapping and mapping.positions == "layout") else None
    placed = (skin.sensors, skin.body.size) if skin else ()
    folder = Path(path if path is not None else source.parent).expanduser()
    if mapping is None:
        recording = read_by_function(str(reader), folder, options or {}, *placed)
    else:
        recording = convert_files(mapping, folder, *placed)
    if file.suffix in ("", ".mcap"):
        from skin.robot.recordings import write_lerobot, write_mcap

        (write_mcap if file.suffix else write_lerobot)(recording, file)
    else:
        write_recording(recording, file)
    print(f"{file}: {summarise_conversion(recording)}")

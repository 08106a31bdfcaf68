"""Convert recordings of others, such as CSV files and spreadsheets, to a recording; or a session to a table.

    skin convert from=map.yaml out=x.parquet
    skin convert reader=package.function path=FOLDER out=x.parquet
    skin convert from=session out=x.csv

A mapping file says what the columns are; a Python function reads everything else (docs/recordings.md).
device=recording device.path=x.parquet trains on the result. The skin of the configuration matters only for a
mapping with positions: layout. The last form writes time, number, raw values and gesture of the frames of a
session (skin record) for a spreadsheet.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from skin.commands._command import command
from skin.core.files import tabular, whole
from skin.errors import InputError
from skin.runs.configuration import Config


@command("convert")
def main(
    config: Config,
    from_: str | None,
    reader: str | None,
    options: Mapping[str, Any] | None,
    path: str | None,
    out: str | None,
) -> None:
    """Read the files of a mapping or by a function, or a session, and write one file."""
    if (from_ is None) == (reader is None) or out is None:
        raise InputError("skin convert needs from= or reader=, and out=, as in from=map.yaml out=x.parquet")
    session, target = Path(from_ or "map.yaml").expanduser(), Path(out).expanduser()
    if (session / "about.json").is_file():
        from pyarrow.csv import write_csv

        from skin.calibration.bench import load_table

        if target.suffix != ".csv":
            raise InputError(f"the table of a session is a .csv file, got {out}: give out=x.csv")
        table, _ = load_table(session, "session")
        with whole(target) as partial:
            write_csv(table, partial)
        print(f"{target}: {len(table)} frames")
        return
    file = tabular(out, "a recording")

    from skin.device.conversion import convert_files, read_by_function, summarise_conversion
    from skin.device.files import write_recording
    from skin.device.formats import read_format
    from skin.runs.build import build_skin

    mapping = None if from_ is None else read_format(from_)
    if path is None and (from_ is None or not from_.endswith((".yaml", ".yml"))):
        source = f"reader={reader}" if from_ is None else f"from={from_}"
        raise InputError(f"{source} needs path=FOLDER, where the recordings are")
    folder = Path(path if path is not None else Path(str(from_)).parent).expanduser()
    if mapping is None:
        recording = read_by_function(str(reader), folder, options or {})
    else:
        skin = build_skin(config) if mapping.positions == "layout" else None
        recording = convert_files(mapping, folder, *((skin.sensors, skin.body.size) if skin else ()))
    write_recording(recording, file)
    print(f"{file}: {summarise_conversion(recording)}")

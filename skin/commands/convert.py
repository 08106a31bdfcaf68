"""Convert recordings of others, such as CSV files and spreadsheets, to a recording of this program.

    skin convert from=map.yaml out=x.parquet
    skin convert from=sdu path=2D_6060_learning_data.xlsx out=sdu.parquet

A mapping file says what the columns are (docs/recordings.md). device=recording device.path=x.parquet trains
on the result. The skin of the configuration matters only for a mapping with positions: layout.
"""

from pathlib import Path

from skin.commands._command import command
from skin.core.files import tabular
from skin.errors import InputError
from skin.runs.configuration import Config


@command("convert")
def main(config: Config, from_: str | None, path: str | None, out: str | None) -> None:
    """Read the files of a mapping and write one recording."""
    if from_ is None or out is None:
        raise InputError("skin convert needs from= and out=, as in from=map.yaml out=x.parquet")
    file = tabular(out, "a recording")

    from skin.device.conversion import convert_files, summarise_conversion
    from skin.device.files import write_recording
    from skin.device.formats import read_format
    from skin.runs.build import build_skin

    mapping = read_format(from_)
    if path is None and not from_.endswith((".yaml", ".yml")):
        raise InputError(f"from={from_} needs path=FOLDER, where the recordings are")
    folder = Path(path if path is not None else Path(from_).parent).expanduser()
    skin = build_skin(config) if mapping.positions == "layout" else None
    recording = convert_files(mapping, folder, *((skin.sensors, skin.body.size) if skin else ()))
    write_recording(recording, file)
    print(f"{file}: {summarise_conversion(recording)}")

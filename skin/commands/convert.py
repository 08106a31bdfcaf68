"""Convert recordings of others, such as CSV files and spreadsheets, to a recording; or a session to a table.

    skin convert from=map.yaml out=x.parquet
    skin convert from=sdu path=2D_6060_learning_data.xlsx out=sdu.parquet
    skin convert from=session out=x.csv
    skin convert from=session.csv out=session

A mapping file says what the columns are (docs/recordings.md). device=recording device.path=x.parquet trains
on the result. The skin of the configuration matters only for a mapping with positions: layout. The third form
writes time, number, raw values and gesture of the frames of a session (skin record) for a spreadsheet; the
last one converts a session of an earlier version.
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
    source, target = Path(from_).expanduser(), Path(out).expanduser()
    if (source / "about.json").is_file():
        from skin.record.session import write_table

        if target.suffix != ".csv":
            raise InputError(f"the table of a session is a .csv file, got {out}: give out=x.csv")
        print(f"{target}: {write_table(source, target)} frames")
        return
    if source.suffix == ".csv":
        from skin.record.recorder import convert_old_session

        print(convert_old_session(source, target))
        return
    file = tabular(out, "a recording")

    from skin.device.conversion import convert_files, summarise_conversion
    from skin.device.files import write_recording
    from skin.device.formats import read_format
    from skin.runs.build import build_skin

    mapping = read_format(from_)
    written = from_.endswith((".yaml", ".yml"))
    if path is None and not written:
        raise InputError(f"from={from_} needs path=FOLDER, where the recordings are")
    folder = Path(path if path is not None else Path(from_).parent).expanduser()
    if mapping.positions == "layout":
        skin = build_skin(config)
        recording = convert_files(mapping, folder, skin.sensors, skin.body.size)
    else:
        recording = convert_files(mapping, folder)
    write_recording(recording, file)
    print(f"{file}: {summarise_conversion(recording)}")

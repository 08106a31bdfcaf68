"""Write simulated touches to a Parquet or CSV file, or as a data set of many shards.

    skin generate n=1000 out=touches.parquet
    skin generate n=1000000 out=touches

A CSV file has the rows alone, for a spreadsheet. A folder is written with flat memory, and a command that was
killed continues when it is repeated. A file also has the displacements under the sensors. Prints a summary of
the touches, and warns if the shape alone predicts a label.
"""

from skin.commands._command import command, output
from skin.runs.configuration import Config, settings_of


@command("generate")
def main(config: Config, n: int, out: str | None) -> None:
    """Draw a budget of n gestures and write readings, labels and parameters."""
    path = output(out, "touches.parquet", ".parquet", ".csv", "")

    from skin.runs.build import build_device
    from skin.runs.generation import generate_data_set, generate_file

    generate = generate_file if path.suffix else generate_data_set
    print(f"{path}: {generate(build_device(config), settings_of(config), path)}")

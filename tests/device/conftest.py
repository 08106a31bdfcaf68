"""What several tests of devices share."""

from dataclasses import replace
from pathlib import Path

from skin.device.files import DataSet, describe_recording, write_manifest, write_recording
from skin.device.touches import Recording


def write_data_set(recording: Recording, folder: Path, counts: tuple[int, ...] = (20, 20, 10)) -> Path:
    source = {"seed": 0, "source_commit": "a", "source_dirty": "false", "config_hash": "1", "config": {}}
    write_manifest(folder, describe_recording(recording), counts, **source)
    data_set = DataSet(folder, complete=False)
    for number, (first, count) in enumerate(zip(data_set.firsts, counts, strict=True)):
        shard = replace(recording[first : first + count], metadata={"config_hash": "1", "summary": {}})
        write_recording(shard, data_set.path(number), first)
    return folder

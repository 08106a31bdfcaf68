"""What reading a skin costs, and what survives a faulty wire: a pseudo-terminal, 1 % of its lines spoilt.

python experiments/benchmarks/wire.py 600 crc16
"""

import json
import os
import sys
import time
import tty
from contextlib import suppress
from multiprocessing import get_context

import numpy as np
import psutil

from skin.port.decoder import Decoder
from skin.port.errors import SkinTimeout
from skin.port.frame import Check
from skin.port.live import Skin
from skin.port.opening import open_skin
from skin.port.text import encode_line

__all__ = ["decode_core_share", "soak"]

SENSORS = 25
_SPOILT = 0.01
_WARM = 0.1  # share of a soak before memory is compared


def decode_core_share(rate: float = 1000.0, frames: int = 20_000) -> float:
    """Return the share of one core that decoding 25 channels at ``rate`` Hz takes, pieces of 512 bytes."""
    data = b"".join(_line(number, 1 / rate, "crc16") for number in range(frames))
    decoder, came, began = Decoder(SENSORS), 0, time.process_time()
    for start in range(0, len(data), 512):
        came += len(decoder.feed(data[start : start + 512], start / len(data) * frames / rate))
    assert came == frames
    return (time.process_time() - began) / frames * rate


def soak(seconds: float, check: Check = "crc16", rate: float = 500.0) -> dict[str, float]:
    """Read from a pseudo-terminal that another process fills, one line of a hundred spoilt.

    A spoilt line has two bits flipped, has lost two bytes, or has lost its end and glues to the next.

    Returns:
        frames ``sent`` and ``intact``, those ``delivered`` with the right values, ``wrong`` ones taken for
        right, ``missed`` ones (intact, but not delivered), the growth of memory in bytes since a tenth of the
        time, the seconds it took (more than asked for where the sender gets no core, and 5 of silence at the
        end), and the share of a core that the reader's process took, with this comparison.
    """
    master, slave = os.openpty()
    tty.setraw(slave)
    count, process = round(seconds * rate), psutil.Process()
    right, wrong, warm = np.zeros(count, dtype=bool), 0, 0
    with open_skin(os.ttyname(slave), range(SENSORS), timeout=5.0) as skin:
        sender = get_context("fork").Process(target=_send, args=(master, count, rate, check), daemon=True)
        sender.start()
        began, start = time.process_time(), time.monotonic()
        for frame in _frames(skin):
            seq = frame.seq or 0
            if seq < count and np.array_equal(frame.values, _values(seq)):
                right[seq] = True
            else:
                wrong += 1
            warm = warm or (seq > _WARM * count and process.memory_info().rss) or 0
        passed = time.monotonic() - start
        share = (time.process_time() - began) / passed
        sender.join()
        grown, stats = process.memory_info().rss - warm, skin.stats
    os.close(master)
    os.close(slave)
    intact = np.array([not _spoilt(number) and not _glued(number - 1) for number in range(count)])
    # Without a CRC the first line is left out: it may be half a line.
    return {
        "seconds": passed,
        "sent": count,
        "intact": int(intact.sum()),
        "delivered": int(right.sum()),
        "missed": int((intact & ~right).sum()),
        "wrong": wrong,
        "bad_frames": stats.bad_frames,
        "dropped": stats.dropped,
        "gaps": stats.gaps,
        "resets": stats.resets,
        "memory_growth_bytes": grown,
        "core_share": share,
    }


def _frames(skin: Skin):
    with suppress(SkinTimeout):
        yield from skin


def _values(number: int) -> list[int]:
    return [(number * (7 + channel) + 31 * channel) % 1024 for channel in range(SENSORS)]


def _line(number: int, period: float, check: Check) -> bytes:
    return encode_line(_values(number), number, round(number * period * 1e6) % 2**32, check)


def _spoilt(number: int) -> bool:
    # The first lines are whole, so that the format shows.
    return number >= 10 and np.random.default_rng((1, number)).random() < _SPOILT


def _glued(number: int) -> bool:
    return number >= 0 and _spoilt(number) and np.random.default_rng((2, number)).random() < 1 / 3


def _spoil(number: int, line: bytes) -> bytes:
    if _glued(number):
        return line[:-1]
    draw = np.random.default_rng((3, number))
    data = bytearray(line[:-1])
    flips = draw.random() < 0.5
    for _ in range(2):
        place = int(draw.integers(len(data)))
        if flips:
            data[place] ^= 1 << int(draw.integers(8))
        else:
            del data[place]
    return bytes(data) + b"\n"


def _send(master: int, count: int, rate: float, check: Check) -> None:
    began = time.monotonic()
    for number in range(count):
        line = _line(number, 1 / rate, check)
        piece = _spoil(number, line) if _spoilt(number) else line
        time.sleep(max(0.0, began + number / rate - time.monotonic()))
        while piece:
            piece = piece[os.write(master, piece) :]


def main() -> None:
    """Print the figures."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    check: Check = sys.argv[2] if len(sys.argv) > 2 else "crc16"  # type: ignore[assignment]
    print(json.dumps({"decode_core_share": decode_core_share()} | soak(seconds, check), indent=2))


if __name__ == "__main__":
    main()

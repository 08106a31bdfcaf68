"""A stream of valid, damaged and invalid frames and noise, and what a decoder recovers of it."""

from random import Random

from skin.wire.decoder import Decoder
from skin.wire.protocol import crc16, encode_line, xor8

_SOUP = b"0123456789,.;-+eE* #\t\r\nnaif_x"
_NO_NUMBERS = (b"nan", b"-inf", b"1e400", b"1_0", b"0x1F", b"--1", b"1.2.3", b"\xd9\xa3", b"1 2", b"")
_INSERTED = (b"\n", b"\0", b"\r\n", b"*", b"#", b",")


def values(number, sensors):
    """Return the values of a frame by its number: unsigned or signed integers, or fractions."""
    kind = number % 3
    whole = [(number * (7 + channel) + 31 * channel) % 1024 - 100 * (kind == 1) for channel in range(sensors)]
    return [value / 8 for value in whole] if kind == 2 else whole


def frame(number, spoken, sensors):
    """Return a frame: a line with one of three checksums."""
    return encode_line(values(number, sensors), number, 2000 * number, spoken)


def invalid(number, spoken, sensors, rng):
    """Return a frame whose checksum is right and whose content is not: none of it may be read as a value."""
    trouble = rng.randrange(5)
    fields = frame(number, "none", sensors).rstrip().split(b",")
    if trouble == 0:
        fields[rng.randrange(len(fields) - 1)] = rng.choice(_NO_NUMBERS)
    elif trouble == 1:
        fields.append(b"5")
    elif trouble == 2:
        fields.pop()
    elif trouble == 3:
        fields[0] = rng.choice((b"-1", b"0.5"))
    body = b",".join(fields)
    tails = {"crc16": b"*%04X" % crc16(body), "xor": b"*%02X" % xor8(body), "none": b""}
    others = [tail for check, tail in tails.items() if check != spoken]
    return body + (rng.choice(others) if trouble == 4 else tails[spoken]) + b"\n"


def noise(rng, sensors):
    """Return bytes at random, text at random, a header or, now and then, a line that never ends."""
    kind, length = rng.random(), rng.choice((1, 10, 100, 400))
    if kind < 0.001:
        data = b"7" * 70_000
    elif kind < 0.5:
        data = rng.randbytes(length)
    elif kind < 0.6:
        data = b"# skin proto=1 n=%d rate=50 unit=adc bits=99\n" % sensors
    else:
        data = bytes(rng.choices(_SOUP, k=length))
    return data + (b"\n" if rng.random() < 0.7 else b"")


def damage(piece, rng):
    """Return a frame with up to five random errors of up to eight bytes."""
    data = bytearray(piece)
    for _ in range(rng.choice((1, 1, 2, 5))):
        first, run = rng.randrange(len(data)), rng.randint(1, 8)
        kind, last = rng.randrange(7), min(first + run, len(data))
        if kind <= 1:
            data[first] ^= 1 << rng.randrange(8)
        elif kind == 6:
            del data[first:]
        else:
            begin = last if kind == 3 else first
            changed = (b"", data[first:last], rng.randbytes(last - first), rng.choice(_INSERTED))[kind - 2]
            data[begin : last if kind != 5 else first] = changed
        data = data or bytearray(b"*")
    return bytes(data)


def fuzz(count, spoken, sensors, seed):
    """Feed a decoder with ``count`` frames, damaged and invalid ones, and noise, in chunks of any size.

    Returns:
        ``good``: numbers of the frames sent intact behind a delimiter; ``missed``: those not recovered;
        ``wrong``: number of frames decoded with wrong values.
    """
    rng = Random(f"{spoken} {sensors} {seed}")
    data, good, kinds = bytearray(), set(), ("good", "damaged", "invalid", "noise")
    for number in range(count):
        # Ten good frames at the beginning, so that the format shows; of them the first may be half a line.
        kind = rng.choices(kinds, (60, 20, 10, 10))[0] if number >= 10 else "good"
        intact = frame(number, spoken, sensors)
        if kind == "good" and data[-1:] in (b"", b"\n") and (number or spoken == "crc16"):
            good.add(number)
        if kind == "damaged":
            intact = damage(intact, rng)
        elif kind == "invalid":
            intact = invalid(number, spoken, sensors, rng)
        elif kind == "noise":
            intact = noise(rng, sensors)
        data += intact
    decoder, position, recovered, wrong = Decoder(sensors), 0, set(), 0
    while position < len(data):
        following = position + rng.randint(0, rng.choice((0, 1, 3, 20, 130, 500, 3000)))
        for found in decoder.feed(bytes(data[position:following]), 0.002 * count * position / len(data)):
            # A value that is sent as a word for none may only be invalid.
            bad = found.seq is None or (found.values != values(found.seq, sensors))[found.valid].any()
            wrong += bad
            recovered |= set() if bad else {found.seq}
        position = following
    return {"good": good, "missed": good - recovered, "wrong": wrong}

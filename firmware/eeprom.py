"""EEPROM image of one board: ``eeprom.py 4x4 --serial-number S1 > s1.eep``, for ``avrdude -U eeprom:w:``.

The layout is in docs/hardware.md. What is not given has the board's default. The number of starts begins anew.
"""

from __future__ import annotations

import argparse
import sys

from ohmskin.emulator.firmware import REFERENCE_BOARDS, BoardSettings
from ohmskin.errors import InputError

RECORD_BYTES = 16


def intel_hex(data: bytes) -> str:
    """The text of an Intel HEX file that begins at address 0."""
    lines = []
    for address in range(0, len(data), RECORD_BYTES):
        piece = data[address : address + RECORD_BYTES]
        record = bytes([len(piece), address >> 8, address & 0xFF, 0]) + piece
        checksum = -sum(record) & 0xFF
        lines.append(f":{record.hex()}{checksum:02x}".upper())
    return "\n".join([*lines, ":00000001FF"]) + "\n"


def main() -> int:
    """Write the image to standard output."""
    kinds = {kind.name: kind for kind in REFERENCE_BOARDS}
    usual = BoardSettings()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("board", choices=kinds)
    parser.add_argument("--serial-number", default=usual.serial_number)
    parser.add_argument("--baud", type=int, default=usual.baud)
    parser.add_argument("--period-us", type=int, default=usual.period_us, help="from frame to frame")
    parser.add_argument("--dwell-us", type=int, help="from selecting a row to its first conversion")
    parser.add_argument("--adc-prescaler-log2", type=int, help="4 to 7: ADC clock 1 MHz to 125 kHz")
    given = vars(parser.parse_args())
    kind = kinds[given.pop("board")]
    try:
        sys.stdout.write(intel_hex(BoardSettings(**given).eeprom(kind)))
    except InputError as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    sys.exit(main())

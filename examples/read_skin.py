"""Print the most pressed cell of each frame: python read_skin.py PORT."""

import sys

from ohmskin.driver import Skin

with Skin.open(sys.argv[1]) as skin:
    for frame in skin:
        row, column = divmod(int(frame.pressure.argmax()), frame.pressure.shape[1])
        print(f"{frame.device_time:7.2f} s  cell {row}, {column}: {frame.pressure.max():5.1f} kPa")

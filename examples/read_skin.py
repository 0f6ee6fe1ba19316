"""Print what touches the skin, frame by frame: python read_skin.py PORT."""

import sys

from ohmskin.driver import Skin

with Skin.open(sys.argv[1]) as skin:
    for frame in skin:
        touches = [f"{c.peak_kpa:.1f} kPa at ({c.x_mm:.0f}, {c.y_mm:.0f}) mm" for c in frame.contacts]
        print(f"{frame.device_time:7.2f} s  {', '.join(touches) or '0 kPa'}")

"""A skin in Rerun: its viewer, or a file for it.

pip install rerun-sdk  # 170 MB
python examples/bridges/rerun_log.py /dev/ttyACM0                       # starts the viewer
python examples/bridges/rerun_log.py press.mcap --save press.rrd
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import rerun as rr

from ohmskin.driver import Frame, Skin
from ohmskin.errors import OhmskinError


def log(frame: Frame, full_scale_kpa: float) -> None:
    """Log one frame: pressures in kPa as a tensor and as an image, contacts and cells at places of their own as
    points, and the sum of forces.
    """
    rr.set_time("host_time", timestamp=frame.host_time)
    if frame.sequence is not None:
        rr.set_time("sequence", sequence=frame.sequence)
    pressure = np.where(frame.valid, frame.pressure, np.nan).astype(np.float32)
    rr.log("skin/pressure_kpa", rr.Tensor(pressure, dim_names=["row", "column"], value_range=[0.0, full_scale_kpa]))
    geometry = frame.geometry
    if geometry.pitch_m is None:
        there = geometry.exists
        share = np.clip(np.nan_to_num(pressure[there]) / full_scale_kpa, 0.0, 1.0)
        colours = np.stack([255 * share, 80 + 0 * share, 255 * (1 - share)], axis=1).astype(np.uint8)
        radii = np.sqrt(geometry.areas_mm2[there] / np.pi)
        points = rr.Points3D if len(geometry.axes) == 3 else rr.Points2D
        rr.log("skin/cells_mm", points(geometry.places_mm[there], radii=radii, colors=colours))
    axes = geometry.axes
    places = [[getattr(contact, axis) for axis in axes] for contact in frame.contacts]
    labels = [f"{contact.id}: {contact.force_n:.2f} N" for contact in frame.contacts]
    marks = rr.Points3D if len(axes) == 3 else rr.Points2D
    rr.log("skin/contacts_mm", marks(np.array(places, dtype=np.float32).reshape(-1, len(axes)), labels=labels))
    rr.log("skin/force_n", rr.Scalars(sum(contact.force_n for contact in frame.contacts)))


def main() -> None:
    parser = argparse.ArgumentParser(description="Show a skin in Rerun.")
    parser.add_argument("port", help="serial device, pty, socket://HOST:PORT or FILE.mcap")
    parser.add_argument("--save", type=Path, help="write FILE.rrd instead of starting the viewer")
    parser.add_argument("--calibration", metavar="FILE.toml", help="of the cells, as `ohmskin calibrate` writes it")
    given = parser.parse_args()
    try:
        log_all(given)
    except OhmskinError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)


def log_all(given: argparse.Namespace) -> None:
    """Log the frames of a port as they come, or all those of a recording."""
    rr.init("ohmskin", spawn=given.save is None)
    if given.save is not None:
        rr.save(given.save)
    with Skin.open(given.port, calibration=given.calibration) as skin:
        full_scale_kpa = 100.0 if skin.cell is None else skin.cell.full_scale_kpa
        for frame in skin:
            log(frame, full_scale_kpa)


if __name__ == "__main__":
    main()

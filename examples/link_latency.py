"""Measure how old frames are when a control loop gets them: python link_latency.py PORT [MS_OF_WORK [SECONDS]]."""

import sys
import time

from ohmskin.driver import Skin

work_s = float(sys.argv[2]) / 1e3 if len(sys.argv) > 2 else 0.0
seconds = float(sys.argv[3]) if len(sys.argv) > 3 else 5.0
with Skin.open(sys.argv[1]) as skin:
    cpu, start = time.process_time(), time.monotonic()
    while time.monotonic() - start < seconds:
        skin.read()
        time.sleep(work_s)
    cpu_share = (time.process_time() - cpu) / (time.monotonic() - start)
    stats = skin.stats()
for name, values in (("age", stats.age_s), ("jitter", stats.jitter_s)):
    print(f"{name:6} / ms", "  ".join(f"{percent} %: {1e3 * value:.2f}" for percent, value in values.items()))
print(f"{stats.rate_hz:.0f} frames/s came, {stats.lost} lost, {stats.skipped} skipped; CPU {100 * cpu_share:.0f} %")

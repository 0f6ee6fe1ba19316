"""Endurance test: many frames without a gap, many hosts that come and go, and no growth of memory or open files.

``python -m ohmskin.emulator.soak SCENE.toml --frames 1000000 --hosts 2000`` prints a line for each part and ends with 1
when one of them failed.
"""

from __future__ import annotations

import argparse
import os
import resource
import socket
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..wire import Corrupt, FramePacket, host_protocol
from ._device import Device
from ._ports import TcpPort
from ._run import running
from ._scene import Scene

MOST_GROWTH_KB = 8192
"""memory that a run may take more at its end than after its first tenth: what the allocator keeps"""


def soak_frames(scene: Scene, frames: int, seed: int = 0) -> tuple[int, int, int]:
    """Carry frames from the board to a host's protocol object, without a port.

    Returns:
        Frames that arrived, frames missing or corrupt, and growth of memory in kB since the first tenth.

    """
    device, host = Device(scene, seed=seed, capacity=2**62), host_protocol("ohmskin")
    expected = faults = arrived = 0
    early_kb = 0
    while arrived + faults < frames:
        device.tick(host_present=True)
        device.advance(device.next_us)
        data = device.arrived()
        device.transmission.taken(len(data))
        for event in host.feed(data, 0.0):
            if isinstance(event, Corrupt):
                faults += 1
            elif isinstance(event, FramePacket) and event.sequence is not None:
                faults += (event.sequence - expected) % 2**32
                expected = (event.sequence + 1) % 2**32
                arrived += 1
        if not early_kb and arrived >= frames // 10:
            early_kb = resident_kb()
    return arrived, faults, resident_kb() - early_kb


def soak_hosts(scene: Scene, hosts: int, seed: int = 0) -> tuple[int, int]:
    """Let hosts come and go over TCP: silent ones, ones that leave in the middle of a packet, ones that send noise.

    Returns:
        Hosts that the board has sent something, of a third that waited for it; and files that are open in the end and
        were not in the beginning.

    """
    random = np.random.default_rng(seed)
    before = len(os.listdir("/proc/self/fd"))
    port = TcpPort.at(":0")
    address = port.name.removeprefix("socket://").rsplit(":", 1)
    served = 0
    with running(scene, port, seed=seed):
        for number in range(hosts):
            with socket.create_connection((address[0], int(address[1])), timeout=60) as host:
                match number % 3:
                    case 1:
                        served += bool(host.recv(int(random.integers(1, 500))))
                    case 2:
                        host.sendall(random.bytes(int(random.integers(1, 500))))
    return served, len(os.listdir("/proc/self/fd")) - before


def resident_kb() -> int:
    """Memory of this process in kB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 1024


def main(arguments: list[str] | None = None, say: Callable[[str], None] = print) -> int:
    """Run both parts; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m ohmskin.emulator.soak", description=__doc__)
    parser.add_argument("scene", metavar="SCENE.toml", type=Path)
    parser.add_argument("--frames", type=int, default=1_000_000, help="default 1000000")
    parser.add_argument("--hosts", type=int, default=2_000, help="default 2000")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    scene = Scene.load(chosen.scene)
    arrived, faults, growth_kb = soak_frames(scene, chosen.frames, chosen.seed)
    say(f"{arrived} frames arrived, {faults} missing or corrupt, memory grew by {growth_kb} kB")
    served, left = soak_hosts(scene, chosen.hosts, chosen.seed)
    say(f"{chosen.hosts} hosts came and went, {served} of them were sent something, {left} files are still open")
    return int(faults > 0 or growth_kb > MOST_GROWTH_KB or left > 0 or served < chosen.hosts // 3)


if __name__ == "__main__":
    sys.exit(main())

"""A skin live in Foxglove, through the WebSocket server of its SDK.

    pip install '.[foxglove]'
    python examples/bridges/foxglove_live.py /dev/ttyACM0

Then choose "Open connection" in Foxglove, and ws://127.0.0.1:8765. An image panel shows the topic ``/ohmskin/pressure``
in kPa; ``/ohmskin/frame`` has numbers and contacts. The messages are those of a recording (``ohmskin record``).
"""

from __future__ import annotations

import argparse
import sys
from typing import Self

import foxglove

from ohmskin.driver import MESSAGE_SCHEMAS, Frame, Skin, messages_of
from ohmskin.errors import OhmskinError


class FoxgloveServer:
    """Sends frames to every Foxglove that is connected."""

    def __init__(self, name: str, host: str = "127.0.0.1", port: int = 8765) -> None:
        """Listen on ``host``, by default for this machine only; ``port`` 0 takes a free one, see :attr:`port`."""
        context = self._context = foxglove.Context()  # whose end would take the channels back
        self._channels = {
            topic: foxglove.Channel(topic, schema=dict(schema), message_encoding="json", context=context)
            for topic, schema in MESSAGE_SCHEMAS.items()
        }
        self._server = foxglove.start_server(name=name, host=host, port=port, context=context)
        self.port = self._server.port

    def show(self, frame: Frame) -> None:
        """Send one frame; a client that is too slow loses the oldest ones."""
        moment_ns = round(frame.host_time * 1e9)
        for topic, message in messages_of(frame).items():
            self._channels[topic].log(message, log_time=moment_ns)

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def main() -> None:
    parser = argparse.ArgumentParser(description="Show a skin live in Foxglove.")
    parser.add_argument("port", help="serial device, pty, socket://HOST:PORT or FILE.mcap")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this machine only)")
    parser.add_argument("--listen", type=int, default=8765, help="TCP port to listen on (default: 8765)")
    parser.add_argument("--calibration", metavar="FILE.toml", help="of the cells, as `ohmskin calibrate` writes it")
    given = parser.parse_args()
    try:
        show(given)
    except OhmskinError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)


def show(given: argparse.Namespace) -> None:
    """Serve the frames of a port as they come, or those of a recording at the speed at which they came."""
    speed = 1.0 if given.port.endswith(".mcap") else None  # a board has its own pace
    with (
        Skin.open(given.port, calibration=given.calibration, speed=speed) as skin,
        FoxgloveServer(skin.port_name, given.host, given.listen) as server,
    ):
        print(f"ws://{given.host}:{server.port}", flush=True)
        for frame in skin:
            server.show(frame)


if __name__ == "__main__":
    main()

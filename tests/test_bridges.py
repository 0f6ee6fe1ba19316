"""The bridges of examples/bridges, each against the real library where it is installed."""

from __future__ import annotations

import asyncio
import base64
import importlib.util
import json
import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from boards import DESIGN, EXAMPLES, Wire, scene

from ohmskin.driver import Frame, Skin
from ohmskin.emulator import Board, PtyPort, running
from ohmskin.errors import InputError


def bridge(name: str) -> ModuleType:
    """A file of examples/bridges as a module."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / "bridges" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def pressed() -> list[Frame]:
    """Frames with a contact and, since the port was noisy, with a loss."""
    with Skin(Wire(Board(scene())), delivery="lossless") as skin:
        return list(islice(skin, 70, 100))


@pytest.fixture(scope="module")
def shaped() -> list[Frame]:
    """Frames of a skin whose cells have places of their own, and one of which is missing."""
    cells = {"row": [0, 0, 1, 2, 2], "column": [0, 1, 1, 0, 1], "x_mm": [0, 9, 9, 1, 9], "y_mm": [0, 0, 9, 18, 17]}
    design = DESIGN | {"shape": cells | {"z_mm": [0, 1, 2, 3, 4]}}
    with Skin(Wire(Board(scene(skin={"design": design}))), delivery="lossless") as skin:
        return list(islice(skin, 70, 100))


# --- LeRobot ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def board() -> Iterator[str]:
    """The port of an emulated board that nothing presses."""
    port = PtyPort()
    with running(scene(contact=[]), port):
        yield port.name


@pytest.mark.parametrize(("form", "history"), [("arrays", 0), ("arrays", 5), ("cells", 0), ("image", 0)])
def test_observations_are_as_their_features_say(board: str, form: str, history: int) -> None:
    lerobot = bridge("lerobot_skin")
    sensor = lerobot.SkinSensor(board, shape=(3, 2), form=form, history=history, max_age=60.0)
    features = sensor.observation_features  # before it is connected
    with pytest.raises(ConnectionError, match="not connected"):
        sensor.get_observation()
    assert not sensor.is_connected
    sensor.connect()
    try:
        assert sensor.is_connected
        assert sensor.is_calibrated
        with pytest.raises(ConnectionError, match="connected already"):
            sensor.connect()
        observed = sensor.get_observation()
    finally:
        sensor.disconnect()
    assert not sensor.is_connected
    assert observed.keys() == features.keys()
    for key, feature in features.items():
        if feature is float:
            assert type(observed[key]) is float
        else:
            assert observed[key].shape == feature
    if history:
        assert observed["skin.is_new"][-1]
        assert (np.diff(observed["skin.monotonic_time"]) >= 0).all()
    with pytest.raises(ConnectionError, match="not connected"):
        sensor.disconnect()


def test_a_skin_of_another_shape_or_under_load_is_refused(board: str) -> None:
    lerobot = bridge("lerobot_skin")
    with pytest.raises(ConnectionError, match=r"a skin of \(3, 2\) cells; expected \(8, 8\)"):
        lerobot.SkinSensor(board, shape=(8, 8)).connect()
    port = PtyPort()
    pressed = {"cells": [[1, 1]], "load_kpa": [[0.0, 15.0], [1.0, 15.0]]}
    with running(scene(contact=[pressed]), port):
        sensor = lerobot.SkinSensor(port.name, shape=(3, 2))
        with pytest.raises(InputError, match="the skin seems to be loaded"):
            sensor.connect()
        assert not sensor.is_connected


def test_an_observation_is_that_of_the_frame(pressed: list[Frame]) -> None:
    lerobot = bridge("lerobot_skin")
    frame = pressed[-1]
    assert frame.pressure[1, 1] > 10
    arrays = lerobot.SkinSensor("x", shape=(3, 2))._observation(frame)
    np.testing.assert_array_equal(arrays["skin.pressure"], frame.pressure.astype(np.float32))
    np.testing.assert_array_equal(arrays["skin.valid"], frame.valid)
    cells = lerobot.SkinSensor("x", shape=(3, 2), form="cells", name="palm")._observation(frame)
    assert cells["palm_1_1.kpa"] == frame.pressure[1, 1]
    image = lerobot.SkinSensor("x", shape=(3, 2), form="image", full_scale_kpa=31.0)._observation(frame)["skin"]
    assert image.dtype == np.uint8
    assert image[1, 1].tolist() == [round(255 * frame.pressure[1, 1] / 31.0)] * 3


class Arm:
    """The least of a LeRobot robot."""

    name = "arm"

    def __init__(self) -> None:
        self.observation_features = {"elbow.pos": float}
        self.action_features = {"elbow.pos": float}
        self.is_connected = self.is_calibrated = False

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected, self.is_calibrated = True, calibrate

    def disconnect(self) -> None:
        self.is_connected = False

    def calibrate(self) -> None:
        self.is_calibrated = True

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        return {"elbow.pos": 1.5}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return action


def test_a_robot_with_a_skin_observes_both_and_acts_as_before(board: str) -> None:
    lerobot = bridge("lerobot_skin")
    robot = lerobot.RobotWithSkin(Arm(), lerobot.SkinSensor(board, shape=(3, 2), form="cells", max_age=60.0))
    assert len(robot.observation_features) == 7
    assert not robot.is_connected
    robot.connect()
    assert robot.is_connected
    assert robot.is_calibrated
    assert robot.get_observation().keys() == robot.observation_features.keys()
    assert robot.send_action({"elbow.pos": 2.0}) == {"elbow.pos": 2.0}
    assert robot.name == "arm"
    robot.disconnect()
    assert not robot.is_connected


# --- Foxglove ---------------------------------------------------------------------------------------------------------


def test_foxglove_receives_the_frames(pressed: list[Frame]) -> None:
    """A client of its WebSocket protocol, written here."""
    pytest.importorskip("foxglove")
    client = pytest.importorskip("websockets.asyncio.client")
    server = bridge("foxglove_live").FoxgloveServer("test", port=0)
    last_ns = round(pressed[-1].host_time * 1e9)

    async def listen() -> dict[str, list[dict[str, Any]]]:
        received: dict[str, list[dict[str, Any]]] = {"/ohmskin/pressure": [], "/ohmskin/frame": []}
        url = f"ws://127.0.0.1:{server.port}"
        async with client.connect(url, subprotocols=["foxglove.sdk.v1"]) as connection:
            channels: dict[int, str] = {}
            while len(channels) < 2:
                message = json.loads(await asyncio.wait_for(connection.recv(), 60))
                if message["op"] == "advertise":
                    for channel in message["channels"]:
                        channels[channel["id"]] = channel["topic"]
                        assert channel["encoding"] == "json"
                        assert json.loads(channel["schema"])["title"] == channel["schemaName"]
            wanted = [{"id": number, "channelId": number} for number in channels]
            await connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            sender = asyncio.create_task(send_until(received))
            # Not a number of messages: the first frame may have arrived more than once.
            while not all(messages and messages[-1]["log_time"] == last_ns for messages in received.values()):
                data = await asyncio.wait_for(connection.recv(), 60)
                if isinstance(data, bytes) and data[0] == 1:
                    number, moment_ns = struct.unpack_from("<IQ", data, 1)
                    payload = json.loads(data[13:])
                    received[channels[number]].append(payload | {"log_time": moment_ns})
            await sender
        return received

    async def send_until(received: dict[str, list[dict[str, Any]]]) -> None:
        # The subscription has no answer: the first frame is sent until it arrives.
        while not all(received.values()):
            server.show(pressed[0])
            await asyncio.sleep(0.05)
        for frame in pressed[1:]:
            server.show(frame)

    with server:
        received = asyncio.run(listen())
    for topic, messages in received.items():
        last = messages[-(len(pressed) - 1) :]
        for frame, message in zip(pressed[1:], last, strict=True):
            assert message["log_time"] == round(frame.host_time * 1e9)
            if topic == "/ohmskin/pressure":
                image = np.frombuffer(base64.b64decode(message["data"]), "<f4").reshape(3, 2)
                np.testing.assert_array_equal(image, frame.pressure.astype("<f4"))
                assert (message["encoding"], message["width"], message["height"]) == ("32FC1", 2, 3)
            else:
                assert message["sequence"] == frame.sequence
                assert [contact["force_n"] for contact in message["contacts"]] == [c.force_n for c in frame.contacts]
    assert received["/ohmskin/frame"][-1]["contacts"]


# --- ROS 2 ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", ["pressed", "shaped"])
def test_ros_messages_survive_their_wire_format(which: str, request: pytest.FixtureRequest) -> None:
    """Against the message definitions of ROS 2 Humble, and CDR, as rosbags has them."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    node = bridge("ros2_node")
    kinds = store.types

    def header() -> Any:
        return kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](0, 0), "")

    def pose() -> Any:
        place, turn = kinds["geometry_msgs/msg/Point"], kinds["geometry_msgs/msg/Quaternion"]
        return kinds["geometry_msgs/msg/Pose"](place(0.0, 0.0, 0.0), turn(0.0, 0.0, 0.0, 0.0))

    def field() -> Any:
        return kinds["sensor_msgs/msg/PointField"]("", 0, 0, 0)

    frame = request.getfixturevalue(which)[-1]
    (contact,) = frame.contacts
    nothing = np.zeros(0, np.uint8)
    blank = {
        "cells": kinds["sensor_msgs/msg/PointCloud2"](header(), 0, 0, [], False, 0, 0, nothing, False),
        "pressure": kinds["sensor_msgs/msg/Image"](header(), 0, 0, "", 0, 0, np.zeros(0, np.uint8)),
        "contacts": kinds["geometry_msgs/msg/PoseArray"](header(), []),
        "frame": kinds["std_msgs/msg/String"](""),
    }
    read = {}
    for topic, fields in node.messages(frame, "palm").items():
        known = {name for name, _ in store.fielddefs[node.TYPES[topic]][1]}
        assert fields.keys() == known
        message = node.fill(blank[topic], fields, field if topic == "cells" else pose)
        if topic in ("pressure", "cells"):
            message.data = np.frombuffer(message.data, np.uint8)  # as rosbags, unlike rclpy, wants it
        read[topic] = store.deserialize_cdr(store.serialize_cdr(message, node.TYPES[topic]), node.TYPES[topic])
    image = read["pressure"]
    pixels = image.data.view("<f4").reshape(image.height, image.width)
    np.testing.assert_array_equal(pixels, np.where(frame.valid, frame.pressure, np.nan).astype("<f4"))
    assert (image.encoding, image.step, image.header.frame_id) == ("32FC1", 8, "palm")
    stamp = image.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == round(frame.host_time * 1e9)
    (found,) = read["contacts"].poses
    assert (found.position.x, found.position.y) == (contact.x_mm / 1e3, contact.y_mm / 1e3)
    assert found.position.z == (contact.z_mm or 0.0) / 1e3
    assert found.orientation.w == 1.0
    assert ("cells" in read) == (which == "shaped")
    if which == "shaped":
        cloud = read["cells"]
        points = cloud.data.view("<f4").reshape(cloud.width, 4)
        assert [each.name for each in cloud.fields] == ["x", "y", "z", "pressure_kpa"]
        np.testing.assert_allclose(
            points[:, :3], np.array([[0, 0, 0], [9, 0, 1], [9, 9, 2], [1, 18, 3], [9, 17, 4]]) / 1e3
        )
        np.testing.assert_array_equal(points[2, 3], np.float32(frame.pressure[1, 1]))
    assert json.loads(read["frame"].data)["sequence"] == frame.sequence


# --- Rerun ------------------------------------------------------------------------------------------------------------


def test_rerun_writes_the_frames_to_a_file(pressed: list[Frame], tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun", reason="rerun-sdk is not installed (170 MB)")
    stream = rerun.RecordingStream("ohmskin-test")
    stream.save(tmp_path / "press.rrd")
    with stream:
        for frame in pressed:
            bridge("rerun_log").log(frame, 31.0)
    stream.flush()
    assert (tmp_path / "press.rrd").stat().st_size > 100 * len(pressed)

"""A ROS 2 node for a skin.

    python examples/bridges/ros2_node.py --ros-args -p port:=/dev/ttyACM0

==================  ============================  ===========================================================
topic               type                          content
==================  ============================  ===========================================================
``~/pressure``      ``sensor_msgs/msg/Image``     32FC1, kPa, a pixel for each cell; invalid cells are NaN
``~/contacts``      ``geometry_msgs/msg/PoseArray``  centres of pressure in m, the largest force first
``~/frame``         ``std_msgs/msg/String``       JSON: numbers and contacts, as in a recording
==================  ============================  ===========================================================

Messages are built as plain tables first (:func:`messages`), which needs no ROS.
"""

from __future__ import annotations

import json
from array import array
from typing import Any

import numpy as np

from ohmskin.driver import Frame, Skin, messages_of

TYPES = {"pressure": "sensor_msgs/msg/Image", "contacts": "geometry_msgs/msg/PoseArray", "frame": "std_msgs/msg/String"}
QUEUE = 10


def messages(frame: Frame, frame_id: str) -> dict[str, dict[str, Any]]:
    """Topic -> fields of its message (:data:`TYPES`), nested as in the message's definition."""
    header = {"stamp": _stamp(frame.host_time), "frame_id": frame_id}
    pressure = np.where(frame.valid, frame.pressure, np.nan).astype("<f4")
    rows, columns = pressure.shape
    image = {
        "header": header,
        "height": rows,
        "width": columns,
        "encoding": "32FC1",
        "is_bigendian": 0,
        "step": 4 * columns,
        "data": array("B", pressure.tobytes()),
    }
    poses = [
        {
            "position": {"x": contact.x_mm / 1e3, "y": contact.y_mm / 1e3, "z": 0.0},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        }
        for contact in frame.contacts
    ]
    numbers = messages_of(frame)["/ohmskin/frame"]
    return {"pressure": image, "contacts": {"header": header, "poses": poses}, "frame": {"data": json.dumps(numbers)}}


def _stamp(host_time: float) -> dict[str, int]:
    seconds, nanoseconds = divmod(round(host_time * 1e9), 10**9)
    return {"sec": seconds, "nanosec": nanoseconds}


def fill(message: Any, fields: dict[str, Any], make_pose: Any) -> Any:
    """Set the fields of a ROS message; ``make_pose`` makes the elements of a list of poses."""
    for name, value in fields.items():
        match value:
            case dict():
                fill(getattr(message, name), value, make_pose)
            case list():
                setattr(message, name, [fill(make_pose(), item, make_pose) for item in value])
            case _:
                setattr(message, name, value)
    return message


def main() -> None:
    import rclpy
    from geometry_msgs.msg import Pose, PoseArray
    from rclpy.executors import ExternalShutdownException
    from sensor_msgs.msg import Image
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node("ohmskin")
    port = node.declare_parameter("port", "/dev/ttyACM0").value
    board = node.declare_parameter("board", "ohmskin").value
    calibration = node.declare_parameter("calibration", "").value or None
    frame_id = node.declare_parameter("frame_id", "skin").value
    kinds = {"pressure": Image, "contacts": PoseArray, "frame": String}
    publishers = {topic: node.create_publisher(kind, f"~/{topic}", QUEUE) for topic, kind in kinds.items()}

    def publish(frame: Frame) -> None:
        for topic, fields in messages(frame, frame_id).items():
            publishers[topic].publish(fill(kinds[topic](), fields, Pose))

    # Every frame: a policy at 30 Hz wants those since its last image, whose header.stamp is on the same clock.
    with Skin.open(port, board=board, calibration=calibration, delivery="every") as skin:
        skin.on_frame(publish)
        try:
            rclpy.spin(node)
        except (KeyboardInterrupt, ExternalShutdownException):
            pass
        finally:
            node.destroy_node()
            rclpy.try_shutdown()


if __name__ == "__main__":
    main()

"""A ROS 2 node for a skin.

    python examples/bridges/ros2_node.py --ros-args -p port:=/dev/ttyACM0

==================  ============================  ===========================================================
topic               type                          content
==================  ============================  ===========================================================
``~/pressure``      ``sensor_msgs/msg/Image``     32FC1, kPa, a pixel for each cell; invalid cells are NaN
``~/cells``         ``sensor_msgs/msg/PointCloud2``  x, y, z in m and kPa of each cell, of a skin that is no rectangle
``~/contacts``      ``geometry_msgs/msg/PoseArray``  centres of force in m, the largest force first
``~/frame``         ``std_msgs/msg/String``       JSON: numbers and contacts, as in a recording
==================  ============================  ===========================================================

Messages are built as plain tables first (:func:`messages`), which needs no ROS.
"""

from __future__ import annotations

import json
from array import array
from typing import Any

import numpy as np

from ohmskin.driver import Frame, Skin, messages_of, points_of

TYPES = {
    "pressure": "sensor_msgs/msg/Image",
    "cells": "sensor_msgs/msg/PointCloud2",
    "contacts": "geometry_msgs/msg/PoseArray",
    "frame": "std_msgs/msg/String",
}
FLOAT32 = 7
"""of ``sensor_msgs/msg/PointField``"""
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
            "position": {"x": contact.x_mm / 1e3, "y": contact.y_mm / 1e3, "z": (contact.z_mm or 0.0) / 1e3},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        }
        for contact in frame.contacts
    ]
    numbers = messages_of(frame)["/ohmskin/frame"]
    found = {"pressure": image, "contacts": {"header": header, "poses": poses}, "frame": {"data": json.dumps(numbers)}}
    return found if frame.geometry.pitch_m is not None else found | {"cells": _cloud(frame, pressure, header)}


def _cloud(frame: Frame, pressure: Any, header: dict[str, Any]) -> dict[str, Any]:
    points = points_of(frame, pressure)
    return {
        "header": header,
        "height": 1,
        "width": len(points),
        "fields": [
            {"name": name, "offset": 4 * k, "datatype": FLOAT32, "count": 1}
            for k, name in enumerate(("x", "y", "z", "pressure_kpa"))
        ],
        "is_bigendian": False,
        "point_step": points.strides[0],
        "row_step": points.nbytes,
        "data": array("B", points.tobytes()),
        "is_dense": not bool(np.isnan(points).any()),
    }


def _stamp(host_time: float) -> dict[str, int]:
    seconds, nanoseconds = divmod(round(host_time * 1e9), 10**9)
    return {"sec": seconds, "nanosec": nanoseconds}


def fill(message: Any, fields: dict[str, Any], make_item: Any) -> Any:
    """Set the fields of a ROS message; ``make_item`` makes the elements of its list: poses, or fields of points."""
    for name, value in fields.items():
        match value:
            case dict():
                fill(getattr(message, name), value, make_item)
            case list():
                setattr(message, name, [fill(make_item(), item, make_item) for item in value])
            case _:
                setattr(message, name, value)
    return message


def main() -> None:
    import rclpy
    from geometry_msgs.msg import Pose, PoseArray
    from rclpy.executors import ExternalShutdownException
    from sensor_msgs.msg import Image, PointCloud2, PointField
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node("ohmskin")
    port = node.declare_parameter("port", "/dev/ttyACM0").value
    board = node.declare_parameter("board", "ohmskin").value
    calibration = node.declare_parameter("calibration", "").value or None
    frame_id = node.declare_parameter("frame_id", "skin").value
    kinds = {"pressure": Image, "cells": PointCloud2, "contacts": PoseArray, "frame": String}
    publishers = {topic: node.create_publisher(kind, f"~/{topic}", QUEUE) for topic, kind in kinds.items()}

    def publish(frame: Frame) -> None:
        for topic, fields in messages(frame, frame_id).items():
            publishers[topic].publish(fill(kinds[topic](), fields, PointField if topic == "cells" else Pose))

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

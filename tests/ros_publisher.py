"""A camera on ROS 2 topics: `python ros_publisher.py FOLDER FPS`, the recorded frames of a folder, over and over."""

import itertools
import sys
import time
from array import array
from pathlib import Path

import cv2
import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image


def image(header, values: np.ndarray, encoding: str) -> Image:
    height, width = values.shape[:2]
    message = Image(header=header, height=height, width=width, encoding=encoding, step=values.strides[0])
    message.data = array("B", values.tobytes())
    return message


def main(folder: str, fps: str) -> None:
    rclpy.init()
    node = rclpy.create_node("a_camera")
    make = node.create_publisher
    topics = [
        make(kind, f"/robot/{name}", qos_profile_sensor_data)
        for kind, name in ((Image, "color/image"), (CameraInfo, "color/info"), (Image, "depth"), (Odometry, "odom"))
    ]
    color, info, depth, odometry = topics
    paths = sorted(Path(folder).glob("*.png"), key=lambda path: float(path.stem))
    back_and_forth = [*paths, *paths[-2:0:-1]]
    for path in itertools.cycle(back_and_forth):
        given = np.load(path.with_suffix(".npz"))
        now = node.get_clock().now().to_msg()
        said = CameraInfo(width=64, height=48, distortion_model="plumb_bob", d=[0.0] * 5)
        fx, fy, cx, cy = given["intrinsics"]
        said.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        said.header.stamp, said.header.frame_id = now, "camera"
        info.publish(said)
        pose = Odometry(child_frame_id="camera")
        pose.header.stamp, pose.header.frame_id = now, "odom"
        T, at = given["T_world_camera"], pose.pose.pose
        at.position.x, at.position.y, at.position.z = T[:3, 3].tolist()
        turn = Rotation.from_matrix(T[:3, :3]).as_quat()
        at.orientation.x, at.orientation.y, at.orientation.z, at.orientation.w = turn.tolist()
        odometry.publish(pose)
        depth.publish(image(said.header, np.rint(1000 * given["depth"]).astype(np.uint16), "16UC1"))
        color.publish(image(said.header, cv2.imread(str(path)), "bgr8"))
        time.sleep(1 / float(fps))


main(*sys.argv[1:])

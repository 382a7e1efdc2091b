"""A ROS 2 node that drives the robot of `fidsplat serve` and receives its images and points.

    fidsplat serve scene.toml --ros2 --lidar vlp-16          # in one terminal, also without ROS
    export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST           # in another one
    python examples/ros2_node.py

It needs rclpy: a ROS 2 installation, or for Python 3.12
`pip install 'ros-jazzy-rclpy[fastrtps]' ros-jazzy-sensor-msgs ros-jazzy-geometry-msgs`.
"""

import time

import rclpy
from geometry_msgs.msg import Twist
from sensor_msgs.msg import Image, PointCloud2

rclpy.init()
node, received = rclpy.create_node("driver"), {}
for topic, kind in (("/camera/image_raw", Image), ("/lidar/points", PointCloud2)):
    node.create_subscription(
        kind, topic, lambda one, topic=topic: received.setdefault(topic, []).append(one), 10
    )
wheel = node.create_publisher(Twist, "/cmd_vel", 10)
drive = Twist()
drive.linear.x = 0.3
end = time.monotonic() + 40
while time.monotonic() < end and min(map(len, received.values()), default=0) < 5:
    wheel.publish(drive)
    rclpy.spin_once(node, timeout_sec=0.1)
for topic, messages in sorted(received.items()):
    one = messages[-1]
    print(f"{topic}: {len(messages)} messages, {one.width} x {one.height}, frame {one.header.frame_id}")
changed = received and received["/camera/image_raw"][0].data != received["/camera/image_raw"][-1].data
print("the image changes as the robot drives" if changed else "the image does not change")

"""ROS 2 logs: MCAP files and rosbag2 folders. Needs `pip install 'fidsplat[logs]'`."""

from fidsplat.logs.reader import LogImage, log_images, log_poses, messages
from fidsplat.logs.robot_log import RobotLog
from fidsplat.logs.writers import check_log

__all__ = ["LogImage", "RobotLog", "check_log", "log_images", "log_poses", "messages"]

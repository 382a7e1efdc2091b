"""Logs that robotics tools open: MCAP files and rosbag2 folders. Needs `pip install 'fidsplat[logs]'`."""

from fidsplat.logs.files import check_log
from fidsplat.logs.log import RobotLog
from fidsplat.logs.reader import LogPicture, log_pictures, log_poses

__all__ = ["LogPicture", "RobotLog", "check_log", "log_pictures", "log_poses"]

"""Image and video files, visualization of outputs, and the tag dictionaries of OpenCV."""

import os

# OpenCV reads this limit when it is loaded. Its default of 2^30 pixels would let a file of 1 MB expand to 12
# GB; 2^28 pixels are twice the largest panorama.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**28))
# FFmpeg's threads write to stderr between the frames of a damaged video, where `without_stderr` has no effect
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

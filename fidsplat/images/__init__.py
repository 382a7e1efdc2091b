"""Image and video files, visualization of outputs, and the tag dictionaries of OpenCV."""

import os

# OpenCV reads its limit when it is loaded. Its default of 2^30 pixels lets a file of 1 MB expand to 12 GB;
# twice the largest panorama is enough for any camera.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**28))
# threads of FFmpeg write to stderr between the frames of a damaged video, outside of `without_stderr`
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

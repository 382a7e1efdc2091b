"""Reading pictures: image files, tag dictionaries, detectors, poses; alone in importing cv2, zxingcpp."""

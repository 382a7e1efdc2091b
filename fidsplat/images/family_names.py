"""Names of tag families in other projects: `tag36h11` of AprilTag, `DICT_4X4_50` of OpenCV."""

import re


def canonical_family(name: str) -> str:
    """Lower-case name of a family, in fidsplat's spelling if it is the name in another project."""
    foreign = foreign_family(name)
    return name.lower() if foreign is None else foreign[1]


def foreign_family(name: str) -> tuple[str, str] | None:
    """Kind and family of a name in another project, such as ("apriltag", "36h11") for "tag36h11"; None for
    other names."""
    match = re.fullmatch(r"(tag|dict_apriltag_|dict_aruco_|dict_)(\w+)", name.lower())
    return match and ("apriltag" if "tag" in match[1] else "aruco", match[2])

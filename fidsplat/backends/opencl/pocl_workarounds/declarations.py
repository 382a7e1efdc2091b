"""Declarations of OpenCL's built-in functions for PoCL 3.0, limited to functions that a program may call.

PoCL's compiler reads 14,000 declarations with each program, a third of the compile time of a new feature set.
"""

import importlib.util
import re
from functools import cache
from pathlib import Path

_HEADER = "pocl_binary_distribution/.libs/share/pocl/include/opencl-c.h"
_TYPES = {sign + name for name in ("char", "short", "int", "long") for sign in ("", "u")}
_TYPES |= {"half", "float", "double"}
_DIGITS = dict.fromkeys(map(ord, "0123456789"))
"""digits are removed before names are compared, as macros append the length of a vector to a name"""
OPTION = "-D_OPENCL_H_"
"""option by which PoCL does not read its own declarations"""


def with_builtin_declarations(text: str, version: str) -> str | None:
    """Prepend to a program text the declarations of the built-in functions that it names; compile the result
    with `OPTION`. None: the header of this version of PoCL is not known."""
    lines = _lines() if "PoCL 3.0" in version else None
    if lines is None:
        return None
    words = set(re.findall(r"[a-z_]\w*", text.translate(_DIGITS)))
    absent = _TYPES - words - {"uint"}  # the parameter of get_global_id, in every kernel
    found = (
        line
        for line, name in lines
        if not name or (name in words and absent.isdisjoint(re.findall("[a-z]+", line)))
    )
    return "\n".join([*found, "#pragma OPENCL EXTENSION all : disable", "#line 1", text])


@cache
def _lines() -> list[tuple[str, str]] | None:
    """Lines of the header, each with the name of the function that it declares, if any."""
    package = importlib.util.find_spec("pocl_binary_distribution")
    header = Path(package.origin).parents[1] / _HEADER if package and package.origin else Path()
    if not header.is_file():
        return None
    text = header.read_text("utf-8").replace("#ifndef _OPENCL_H_", "#if 1")
    text = text.replace('"opencl-c-base.h"', f'"{header.with_name("opencl-c-base.h")}"')
    found, lines = [], iter(text.splitlines())
    for line in lines:
        name = ""
        if "__ovld" in line and line[0] != "#":
            while ";" not in line:
                line += " " + next(lines)
            name = line.partition("(")[0].split()[-1].translate(_DIGITS)
        if line and not line.startswith("//"):
            found.append((line, name))
    return found

"""`fidsplat devices`."""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from fidsplat.commands.output import Json, tell

if TYPE_CHECKING:
    from fidsplat.backends.interface import DeviceInfo


@dataclass
class Devices:
    """List the devices that can draw here, and why the others cannot.

    The first column is what --device takes.

    Examples:
      fidsplat devices
      fidsplat devices --json
    """

    json: Json = False

    def run(self) -> int:
        import fidsplat as fs

        found = fs.devices()
        table = "Devices", ("device", "what it is", "memory", "can draw"), map(_row, found)
        return tell(self.json, {"devices": [asdict(info) for info in found]}, table=table)


def _row(info: "DeviceInfo") -> tuple[str, ...]:
    units = f"{info.compute_units} unit" + ("" if info.compute_units == 1 else "s")
    what = f"{info.title}\n{info.kind}, {units}, {'with' if info.float64 else 'no'} float64\n"
    version = info.version if info.platform in info.version else f"{info.platform}: {info.version}"
    usable = "yes" if info.usable else "no"
    return (
        info.name,
        what + version,
        f"{info.memory_bytes / 2**30:.1f} GiB",
        f"{usable}: {info.reason}" if info.reason else usable,
    )

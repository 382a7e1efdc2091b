"""One module for each command: a dataclass of its options, whose ``run`` does the work and returns the exit
status. Its docstring is what `fidsplat COMMAND --help` says, and the first line of that stands in the list of
commands. A group of commands has PARTS instead, or as well: its commands by the word that follows.

Nothing heavy is imported before ``run``, so that help and errors come at once.
"""

from fidsplat.commands.bench import Bench
from fidsplat.commands.check import Check
from fidsplat.commands.convert import Convert
from fidsplat.commands.demo import Demo
from fidsplat.commands.detect import Detect
from fidsplat.commands.devices import Devices
from fidsplat.commands.experiment import Experiment
from fidsplat.commands.fly import Fly
from fidsplat.commands.gallery import Gallery
from fidsplat.commands.greenhouse import Greenhouse
from fidsplat.commands.info import Info
from fidsplat.commands.marker import Marker
from fidsplat.commands.render import Render
from fidsplat.commands.source import Source
from fidsplat.commands.store import Store
from fidsplat.commands.tradeoff import Tradeoff
from fidsplat.commands.train import Train
from fidsplat.commands.view import View
from fidsplat.commands.warm import Warm

COMMANDS = {
    "demo": Demo,
    "devices": Devices,
    "info": Info,
    "marker": Marker,
    "render": Render,
    "view": View,
    "fly": Fly,
    "detect": Detect,
    "convert": Convert,
    "check": Check,
    "bench": Bench,
    "tradeoff": Tradeoff,
    "warm": Warm,
    "experiment": Experiment,
    "gallery": Gallery,
    "greenhouse": Greenhouse,
    "train": Train,
    "store": Store,
    "source": Source,
}
"""Every command by its name, in the order in which help lists them."""

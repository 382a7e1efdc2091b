"""Commands: a dataclass of options for each, whose method `run` executes it and returns the exit status.

The docstring of a command is its help. Its options are its fields and those of the settings dataclasses that
it nests or inherits. A command group has PARTS: its commands by name. Command modules are imported on demand,
so that `fidsplat --help` and errors are printed without delay.
"""

import ast
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path


class CommandTable(Mapping[str, type]):
    """Command classes by name, imported on access. Underscores of names become hyphens."""

    def __init__(self, **classes: str) -> None:
        self._classes = {name.replace("_", "-"): path for name, path in classes.items()}

    def __getitem__(self, name: str) -> type:
        module, _, kind = self._classes[name].partition(".")
        return getattr(import_module(f"{__name__}.{module}"), kind)

    def __iter__(self) -> Iterator[str]:
        return iter(self._classes)

    def __len__(self) -> int:
        return len(self._classes)

    def summary(self, name: str) -> str:
        """First docstring line of a command, read from its source without importing it."""
        module, _, kind = self._classes[name].partition(".")
        tree = ast.parse(Path(__file__).with_name(f"{module}.py").read_text("utf-8"))
        definition = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == kind)
        return (ast.get_docstring(definition) or "").partition("\n")[0]


COMMANDS = CommandTable(
    demo="demo.Demo",
    devices="devices.Devices",
    info="info.Info",
    marker="marker.Marker",
    render="render.Render",
    view="view.View",
    fly="fly.Fly",
    detect="detect.Detect",
    scan="scan.Scan",
    serve="serve.Serve",
    convert="convert.Convert",
    check="check.Check",
    bench="bench.Bench",
    tradeoff="tradeoff.Tradeoff",
    warm="devices.Warm",
    experiment="experiment.Experiment",
    gallery="render.Gallery",
    fetch="fetch.Fetch",
    greenhouse="greenhouse.Greenhouse",
    plan_tags="plan_tags.PlanTags",
    capture="capture.Capture",
    train="train.Train",
    localise="localise.Localise",
    store="store.Store",
    source="source.Source",
)
"""all commands, in the order of the help"""

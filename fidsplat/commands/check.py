"""Command `fidsplat check`: test a device with hard cases of splat rendering."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fidsplat.commands.options import Device, Json
from fidsplat.commands.output import (
    console,
    delayed_progress,
    print_json,
    print_lines,
    print_table,
    steps_shown,
)
from fidsplat.util.errors import InputError, counted
from fidsplat.util.files import writable_folder

if TYPE_CHECKING:
    from rich.console import Console

    from fidsplat.render.renderer import Renderer
    from fidsplat.selftest.check import CheckResult
    from fidsplat.selftest.fuzz import FuzzState


@dataclass
class Check:
    """Test a device with the hard cases of splat rendering.

    Renders scenes that are known to break renderers, compares every pixel with a float64 reference,
    measures the device's arithmetic, and lists failures. Takes about half a minute on two cores. Writes an
    image of the worst case to DIR/worst.png. The exit status is 1 if a check fails.

    --fuzz renders random scenes of up to 200 splats instead, until their splats add up to N. An interrupted
    run resumes (DIR/fuzz.json).

    --digests renders 200 random scenes instead and compares the SHA-256 of each with the repository's: all
    devices with float64 and fused multiply-adds render bit-identical images. --json prints the digest of each
    scene; for a scene that differs also those of its outputs and of the results between the stages.

    Examples:
      fidsplat check
      fidsplat check --device opencl:nvidia --json
      fidsplat check --fuzz 100000
      fidsplat check --digests --device warp:cuda
    """

    device: Device = None
    out: str = "fidsplat-check"
    """DIR: folder for the image and the fuzzer's state"""
    fuzz: int | None = None
    """N: render random scenes until their splats add up to N"""
    digests: bool = False
    """compare the digests of 200 random scenes"""
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs

        if self.fuzz is not None and self.fuzz < 1:
            raise InputError(f"--fuzz must be at least 1 splat, got {self.fuzz}")
        if self.fuzz is not None and self.digests:
            raise InputError("at most one of --fuzz and --digests must be given, got both; leave one out")
        where = console(self.json)
        with where.status("opening the device"):
            renderer = fs.Renderer(self.device)
        if self.digests:
            return self._digests(renderer, where)
        folder = writable_folder(self.out)
        if self.fuzz is not None:
            return self._fuzz(renderer, folder, where)
        from fidsplat.images.files import write_png
        from fidsplat.selftest.catalogue import all_cases
        from fidsplat.selftest.check import run_check, worst_image

        with steps_shown(where, "starting") as update:
            result = run_check(renderer, all_cases(), update)
        file = None if result.worst is None else write_png(folder / "worst.png", worst_image(result.worst))
        if self.json:
            print_json({**result.as_dict(), "picture": file and str(file)})
        else:
            _print(result, where)
            if file is not None:
                print_lines(where, f"worst case in {file}")
        return 0 if result.passed else 1

    def _digests(self, renderer: "Renderer", where: "Console") -> int:
        from fidsplat.selftest import digests
        from fidsplat.selftest.tables import digest_table

        expected = digests.read_table()
        measured: dict[int, digests.Digest] = {}
        with delayed_progress() as progress:
            for seed in expected:
                progress(digests.kind_of(seed).name, len(measured) / len(expected))
                measured[seed] = digests.digest_of(renderer, seed)
        differing = {
            seed: digest.differing(expected[seed])
            for seed, digest in measured.items()
            if digest != expected[seed]
        }
        if self.json:
            details = [
                {
                    "seed": seed,
                    "scenes": digests.kind_of(seed).name,
                    "differing": names,
                    "outputs": measured[seed].outputs,
                    "stages": digests.stage_digests(renderer, seed),
                }
                for seed, names in differing.items()
            ]
            sums = {seed: digest.sha256 for seed, digest in measured.items()}
            name, passed = renderer.device.name, not differing
            print_json({"device": name, "passed": passed, "sha256": sums, "differing": details})
        else:
            print_table(where, *digest_table(measured, differing, renderer.device.title))
            print_lines(
                where, f"{len(measured) - len(differing)} of {len(measured)} scenes are bit-identical"
            )
        return 1 if differing else 0

    def _fuzz(self, renderer: "Renderer", folder: Path, where: "Console") -> int:
        from fidsplat.selftest.fuzz import fuzz_run

        total, state = self.fuzz or 0, None
        with delayed_progress() as progress:
            for state in fuzz_run(renderer, total, folder / "fuzz.json"):
                progress(f"{state.splats:,} splats", min(state.splats / total, 1.0))
        assert state is not None
        if self.json:
            print_json({"device": renderer.device.name, "passed": state.passed, **vars(state)})
        else:
            _print_fuzz(state, renderer, where)
        return 0 if state.passed else 1


def _print(result: "CheckResult", where: "Console") -> None:
    from fidsplat.selftest.tables import arithmetic_table, case_table

    device = result.device
    if (facts := result.arithmetic) is not None:
        print_table(where, *arithmetic_table(facts, device.title))
        denormals = "preserved" if facts.denormals else "flushed to 0"
        print_lines(
            where, f"float64: {'yes' if facts.float64 else 'no'}; float32 below 1.2e-38: {denormals}\n"
        )
    print_lines(where, f"Hard cases on {device.title}, {device.version}")
    print_table(where, *case_table(result))
    print_lines(where, *(f"failed: {words}" for words in result.failures))
    wrong = len(result.failures)
    verdict = f"{counted(wrong, 'checks')} failed" if wrong else "all checks passed"
    print_lines(where, f"{verdict}; {result.seconds:.0f} s")


def _print_fuzz(state: "FuzzState", renderer: "Renderer", where: "Console") -> None:
    from fidsplat.selftest.tables import fuzz_table

    print_table(where, *fuzz_table(state, renderer.device.title))
    print_lines(
        where,
        f"{state.splats:,} splats in {state.scenes:,} scenes, {state.pixels:,} pixels, "
        f"{state.risky / max(state.pixels, 1):.2%} with error bounds above 0.05; {state.seconds:.0f} s\n"
        f"failing seeds: {' '.join(map(str, state.failing)) or 'none'}",
    )

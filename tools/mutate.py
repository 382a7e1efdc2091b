"""Mutation testing: inject one small bug at a time into a copy of the tree and run the tests that fit.

    python tools/mutate.py --count 80 --seed 7                run a seeded sample, spread over the packages
    python tools/mutate.py --package kernels/opencl --count 10   only of packages with this in their path
    python tools/mutate.py --list                             print the sample without running it
    python tools/mutate.py --survivors                        run the recorded survivors again
    python tools/mutate.py --report                           print the score per package and the survivors
    python tools/mutate.py --equivalent KEY 'reason'          mark a survivor that changes no behaviour

Each result is a line of mutations.jsonl (the last line of a key holds), and a sample that was stopped resumes
there. The operators work on tokens, so they are the same for Python, Warp kernels and OpenCL C.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import hashlib
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONTRACT = "tests/contract tests/stages tests/hard_cases"
UNIT, EXPERIMENTS = "tests/unit", "tests/experiments"
TESTS = {  # package or file: test files and folders, and an expression for -k; the longest prefix holds
    "kernels/opencl": (f"{CONTRACT} tests/unit/test_store_hidden.py", "not warp"),
    "kernels/opencl/train": ("tests/contract/test_training*.py tests/contract/test_refine.py", ""),
    "kernels/opencl/store": ("tests/unit/test_store*.py", "not warp"),
    "kernels/warp": (f"{CONTRACT} tests/unit/test_warp*.py", "warp"),
    "fidsplat": (f"{UNIT} tests/contract", ""),
    "fidsplat/backends": (f"{CONTRACT} {UNIT}", "not warp"),
    "fidsplat/backends/opencl": (f"{CONTRACT} tests/unit/test_store*.py", "not warp"),
    "fidsplat/backends/reference": (f"{UNIT}/test_*reference.py {CONTRACT}", "not warp"),
    "fidsplat/backends/warp": (f"{CONTRACT} tests/unit/test_warp*.py", "warp"),
    "fidsplat/budget": ("tests/unit/test_budget.py tests/unit/test_accuracy.py", ""),
    "fidsplat/cameras": (f"{UNIT}/test_[clmt]*.py tests/contract/test_lens_pictures.py", "not warp"),
    "fidsplat/commands": (f"{UNIT} {EXPERIMENTS}", ""),
    "fidsplat/effects": (f"{UNIT} tests/compile tests/contract", "not warp"),
    "fidsplat/experiments": (f"{EXPERIMENTS} {UNIT}", ""),
    "fidsplat/formats": (f"{UNIT} {EXPERIMENTS}/test_dataset.py tests/hard_cases", "not warp"),
    "fidsplat/hard_cases": ("tests/hard_cases tests/contract/test_certificates.py", "not warp"),
    "fidsplat/logs": (f"{UNIT}/test_logs.py {UNIT}/test_flights.py", ""),
    "fidsplat/markers": (f"{UNIT}/test_[mv]*.py tests/contract/test_facets.py", "not warp"),
    "fidsplat/remote": (f"{UNIT}/test_remote*.py {UNIT}/test_flights.py", ""),
    "fidsplat/scenes": (f"{UNIT}/test_[sci]*.py", ""),
    "fidsplat/sim": (f"{UNIT} {EXPERIMENTS}/test_plants.py", ""),
    "fidsplat/store": (f"{UNIT}/test_s*.py {UNIT}/test_l*.py tests/contract/test_denser_splats.py", ""),
    "fidsplat/train": (f"{UNIT}/test_train*.py tests/contract/test_train*.py tests/contract/test_refine.py", ""),
    "fidsplat/viewer": (f"{UNIT}/test_viewer*.py", ""),
    "fidsplat/vision": (f"{UNIT} {EXPERIMENTS}", ""),
}  # fmt: skip
MOST_FILES = 12
"""of tests for one mutation, the most fitting of the map"""
TEST_SECONDS = 30
"""of CPU time, after which a test hangs"""
LIMIT = -signal.SIGXCPU
INVALID = re.compile(r"BUILD_PROGRAM_FAILURE|clBuildProgram|Warp\w*Codegen\w*Error|Error while parsing function")

_LITERALS = r"""'''.*?'''|\"\"\".*?\"\"\"|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'"""
_SKIPPED = {
    ".py": rf"{_LITERALS}|\#[^\n]*|^\s*(?:@|from\s|import\s)[^\n]*",
    ".cl": rf"{_LITERALS}|//[^\n]*|/\*.*?\*/|^[ \t]*\#[ \t]*(?:if|elif|include|pragma|undef)[^\n]*",
}
_TOKENS = {
    ending: re.compile(
        rf"(?P<skip>{skipped}|\s+|\\\n)|(?P<number>0[xX][\da-fA-F]+\w*|(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][+-]?\d+)?[fuUlL]*)"
        r"|(?P<name>[A-Za-z_]\w*)|(?P<op>->|\*\*|<<=?|>>=?|//|&&|\|\||[-+*/<>=!&|^%]=|.)",
        re.DOTALL | re.MULTILINE,
    )
    for ending, skipped in _SKIPPED.items()
}
_KEYWORDS = {"return", "and", "or", "not", "in", "is", "if", "else", "elif", "while", "yield", "lambda", "assert"}
_COMPARED = {"<": ("<=", ">"), "<=": ("<", ">="), ">": (">=", "<"), ">=": (">", "<="), "==": ("!=",), "!=": ("==",)}
_PAIRS = "min max|fmin fmax|minimum maximum|argmin argmax|floor ceil|any all|sin cos|fminf fmaxf|amin amax"
_EXTREMES = {a: b for pair in _PAIRS.split("|") for a, b in (pair.split(), pair.split()[::-1])}
_WORDS = {"width": "height", "height": "width", "rows": "columns", "columns": "rows", "row": "column", "column": "row"}
_LOOSE, _TIGHT = {"+", "-"}, {"*", "/", "%", "//"}


@dataclass(frozen=True)
class Mutation:
    """One injected bug."""

    package: str
    path: str
    line: int
    operator: str
    start: int
    end: int
    text: str
    """that replaces [start, end) of the file"""
    was: str
    """source line before and after"""
    becomes: str

    @property
    def key(self) -> str:
        return hashlib.blake2b(repr((self.path, self.was, self.becomes)).encode(), digest_size=5).hexdigest()


def edits(text: str, ending: str) -> Iterator[tuple[str, int, int, str]]:
    """All mutations of a source text: operator, start, end, replacement."""
    found = [m for m in _TOKENS[ending].finditer(text) if m.lastgroup != "skip"]
    words = [m.group() for m in found]
    names = set(words)
    for i, m in enumerate(found):
        word, before, after = m.group(), words[i - 1] if i else "", words[i + 1] if i + 1 < len(words) else ""
        binary = i > 0 and _ends_operand(found[i - 1])
        if m.lastgroup == "number":
            inside = before == "[" and after == "]" and i > 1 and _ends_operand(found[i - 2])
            for value in _other_numbers(word):
                yield ("index" if inside else "constant"), *m.span(), value
        elif m.lastgroup == "name":
            swapped = _other_axis(word)
            if swapped and (swapped in names or before == "."):
                yield "axis", *m.span(), swapped
            if word in _EXTREMES and after == "(":
                yield "min/max", *m.span(), _EXTREMES[word]
            if word in ("and", "or"):
                yield "logic", *m.span(), "or" if word == "and" else "and"
            if word == "not" and before != "is" and after != "in":
                yield "logic", *m.span(), ""
        elif word in _COMPARED:
            yield from (("comparison", *m.span(), other) for other in _COMPARED[word])
        elif word in ("+=", "-=", "*=", "/="):
            yield "sign", *m.span(), {"+=": "-=", "-=": "+=", "*=": "/=", "/=": "*="}[word]
        elif word in _LOOSE:
            yield "sign", *m.span(), {"+": "-", "-": "+"}[word] if binary else " "
        elif word in ("&&", "||"):
            yield "logic", *m.span(), "||" if word == "&&" else "&&"
        elif word == "!" and ending == ".cl":
            yield "logic", *m.span(), ""
        if binary and (word in _LOOSE | _TIGHT or word in ("&&", "||", "and", "or")):
            if end := _end_of_term(words, i + 1, word):
                yield "dropped term", m.start(), found[end - 1].end(), ""


def _ends_operand(token: re.Match[str]) -> bool:
    return token.group() in (")", "]", "}") or (token.lastgroup != "op" and token.group() not in _KEYWORDS)


def _end_of_term(words: list[str], at: int, operator: str) -> int | None:
    """Index after the operand that begins at `at`, with its factors after a plus or minus."""
    binding = {*_TIGHT, "**"} if operator in _LOOSE else {"**"} if operator in _TIGHT else None
    if binding is None:
        binding = {*_LOOSE, *_TIGHT, "**", "<", ">", "<=", ">=", "==", "!=", "is", "in", "not"}
    while True:
        while at < len(words) and words[at] in ("-", "+", "!", "~", "not"):
            at += 1
        if at >= len(words):
            return None
        at = _end_of_group(words, at) if words[at] in "([{" else at + 1
        while at < len(words) and words[at] in ("(", "[", "."):
            at = at + 2 if words[at] == "." else _end_of_group(words, at)
        if at >= len(words) or words[at] not in binding:
            return at
        at += 1


def _end_of_group(words: list[str], at: int) -> int:
    depth = 0
    while at < len(words):
        depth += (words[at] in "([{") - (words[at] in ")]}")
        at += 1
        if depth == 0:
            break
    return at


def _other_axis(word: str) -> str | None:
    if word in _WORDS:
        return _WORDS[word]
    if word in ("s0", "s1"):
        return "s1" if word == "s0" else "s0"
    if re.fullmatch(r"xy|yx|(?:\w+_)?[a-z]?[xy]", word):
        return word[:-2] + word[:-3:-1] if word in ("xy", "yx") else word[:-1] + ("y" if word[-1] == "x" else "x")
    return None


def _other_numbers(word: str) -> list[str]:
    digits = word.rstrip("fuUlL") if not word.lower().startswith("0x") else ""
    if not digits:
        return []
    suffix = word[len(digits) :]
    if re.fullmatch(r"[\d_]+", digits) and "f" not in suffix:
        value = int(digits)
        return [f"{other}{suffix}" for other in (value + 1, value - 1) if other >= 0]
    value = float(digits)
    return [f"{1.25 * value if value else 0.5!r}{suffix}"]


def sources() -> dict[str, list[Path]]:
    """Package -> files. A package of fidsplat is its folder, or `fidsplat` for a module directly in it."""
    found: dict[str, list[Path]] = {}
    for folder, endings in ((ROOT / "fidsplat", {".py"}), (ROOT / "kernels", {".py", ".cl"})):
        for file in sorted(folder.rglob("*")):
            if file.suffix in endings and file.name != "__init__.py":
                path = file.relative_to(ROOT).as_posix()
                prefix = max((name for name in TESTS if path.startswith(f"{name}/")), key=len)
                found.setdefault(prefix, []).append(file)
    return found


def sample(count: int, seed: int, package: str) -> list[Mutation]:
    """Seeded mutations; a package's number grows with the square root of its source's size, and each operator
    of a package is as likely. The first `n` of a larger sample are the sample of `n`."""
    random_ = random.Random(seed)
    packages = {name: files for name, files in sources().items() if package in name}
    weights = {name: sum(file.stat().st_size for file in files) ** 0.5 for name, files in packages.items()}
    sites: dict[str, dict[str, list[tuple[Path, int, int, str]]]] = {}
    for name, files in packages.items():
        for file in files:
            for operator, *edit in edits(file.read_text("utf-8"), file.suffix):
                sites.setdefault(name, {}).setdefault(operator, []).append((file, *edit))
    drawn, chosen = dict.fromkeys(sites, 0), {}
    while len(chosen) < count:
        name = min(drawn, key=lambda name: (drawn[name] + 1) / weights[name])
        operator = random_.choice(sorted(sites[name]))
        mutation = _mutation(name, operator, *random_.choice(sites[name][operator]))
        if mutation and mutation.key not in chosen:
            chosen[mutation.key] = mutation
            drawn[name] += 1
    return list(chosen.values())


def _mutation(package: str, operator: str, file: Path, start: int, end: int, text: str) -> Mutation | None:
    """None where Python does not accept the result."""
    source = file.read_text("utf-8")
    mutated = source[:start] + text + source[end:]
    if file.suffix == ".py":
        try:
            ast.parse(mutated)
        except SyntaxError:
            return None
    line = source.count("\n", 0, start)
    was, becomes = (each.split("\n")[line].strip() for each in (source, mutated))
    path = file.relative_to(ROOT).as_posix()
    return Mutation(package, path, line + 1, operator, start, end, text, was, becomes)


def tests_for(mutation: Mutation) -> list[str]:
    """Arguments of pytest: the files of the map, first those that mention the words of the file's name most."""
    patterns, expression = TESTS[mutation.package]
    files: dict[Path, int] = {}
    words = [word for word in re.split(r"[_/.]", mutation.path)[2:-1] if len(word) > 2]
    for pattern in patterns.split():
        for place in sorted(ROOT.glob(pattern)):
            for file in sorted(place.rglob("test_*.py")) if place.is_dir() else [place]:
                text = file.read_text("utf-8")
                files.setdefault(file, sum(min(text.count(word), 8) + 9 * (word in file.name) for word in words))
    order = sorted(files, key=lambda file: -files[file])
    return [*(file.relative_to(ROOT).as_posix() for file in order[:MOST_FILES]), *(["-k", expression] if expression else [])]


class Tree:
    """A copy of the working tree in which one mutation at a time is applied."""

    def __init__(self, folder: Path, limit: float) -> None:
        self._folder, self._limit = folder, limit
        self._passes: dict[str, bool] = {}
        listed = subprocess.run(["git", "ls-files", "-coz", "--exclude-standard"], cwd=ROOT, capture_output=True, check=True)
        for name in filter(None, listed.stdout.decode().split("\0")):
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)

    def run(self, mutation: Mutation) -> dict[str, str]:
        """`result` (caught, survived, invalid) with the test and how it ended. first: a test to run before."""
        file = self._folder / mutation.path
        text = file.read_text("utf-8")
        mutated = text[: mutation.start] + mutation.text + text[mutation.end :]
        file.write_text(mutated, "utf-8")
        try:
            while True:
                broken = [word for test, passes in self._passes.items() if not passes for word in ("--deselect", test)]
                status, test, output = self._pytest([*tests_for(mutation), *broken])
                if INVALID.search(output):
                    return {"result": "invalid", "test": test, "how": "does not compile"}
                if status in (0, LIMIT) or not test:
                    return {"result": "survived", "test": "", "how": {0: "", LIMIT: "limit"}.get(status, f"status {status}")}
                file.write_text(text, "utf-8")
                if self._passes.setdefault(test, self._alone(test)):
                    how = {-signal.SIGPROF: "hangs"}.get(status, "fails" if status > 0 else f"signal {-status}")
                    return {"result": "caught", "test": test, "how": how}
                file.write_text(mutated, "utf-8")
        finally:
            file.write_text(text, "utf-8")

    def _alone(self, test: str) -> bool:
        """Whether a test, or the import of a test file, passes without the mutation."""
        return self._pytest([test, "-m", "", *([] if "::" in test else ["--collect-only"])])[0] == 0

    def _pytest(self, arguments: list[str]) -> tuple[int, str, str]:
        """Exit status, negative for a signal; the test that failed or was running; the output."""
        path = os.pathsep.join(str(self._folder / name) for name in (".", "tools"))
        environment = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "999"}
        command = [sys.executable, "-m", "pytest", "-n", "0", "-x", "-v", "-p", "mutate", "-p", "no:cacheprovider", *arguments]
        limited = lambda: resource.setrlimit(resource.RLIMIT_CPU, (int(self._limit), int(self._limit) + 5))  # noqa: E731
        with tempfile.TemporaryFile() as stream:
            child = subprocess.Popen(command, cwd=self._folder, env=environment, stdout=stream, stderr=stream, start_new_session=True, preexec_fn=limited)
            try:
                status = child.wait(10 * self._limit)
            except subprocess.TimeoutExpired:
                status = LIMIT
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(child.pid, signal.SIGKILL)
                child.wait()
            stream.seek(0)
            output = stream.read().decode("utf-8", "replace")
        failed = re.search(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", output, re.MULTILINE)
        begun = re.findall(r"^(\S+\.py::.*?)(?: (?:PASSED|SKIPPED|FAILED|ERROR|Fatal)\b.*)?$", output, re.MULTILINE)
        return status, failed[1] if failed else begun[-1].strip() if begun and status else "", output


def pytest_runtest_logstart() -> None:
    """End pytest by a signal when one test takes too long. This module is a plugin of the runs it starts."""
    signal.setitimer(signal.ITIMER_PROF, TEST_SECONDS)


def report(rows: dict[str, dict]) -> str:
    """Markdown: the score per package, then survivors and equivalent mutations."""
    lines = ["| package | mutations | caught | survived | equivalent | share |", "|---|---|---|---|---|---|"]
    for package in (*sorted({row["package"] for row in rows.values()}), ""):
        results = [row["result"] for row in rows.values() if package in ("", row["package"])]
        caught, survived, equivalent = (results.count(each) for each in ("caught", "survived", "equivalent"))
        share = f"{100 * caught / (caught + survived):.0f} %" if caught + survived else "-"
        total = caught + survived + equivalent
        lines.append(f"| {package or 'all'} | {total} | {caught} | {survived} | {equivalent} | {share} |")
    for result in ("survived", "equivalent"):
        lines += ["", f"{result}:", ""] + [
            f"- `{row['key']}` {row['path']}:{row['line']} ({row['operator']}): `{row['was']}` -> `{row['becomes']}` {row['how']}"
            for row in rows.values()
            if row["result"] == result
        ]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=80, help="mutations of the sample")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--package", default="", help="only packages with this in their path")
    parser.add_argument("--limit", type=float, default=60, help="seconds of CPU time for the tests of one mutation")
    parser.add_argument("--results", type=Path, default=Path("mutations.jsonl"))
    parser.add_argument("--survivors", action="store_true", help="run the recorded survivors again")
    parser.add_argument("--equivalent", nargs=2, metavar=("KEY", "REASON"))
    parser.add_argument("--list", action="store_true", help="print the sample without running it")
    parser.add_argument("--report", action="store_true", help="print the recorded results")
    options = parser.parse_args()
    lines = options.results.read_text("utf-8").splitlines() if options.results.exists() else []
    rows = {row["key"]: row for row in map(json.loads, lines)}

    def record(row: dict) -> None:
        rows[row["key"]] = row
        with options.results.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row) + "\n")

    if options.equivalent:
        key, reason = options.equivalent
        record(rows[key] | {"result": "equivalent", "how": reason})
    if options.equivalent or options.report:
        print(report(rows))
        return 0
    chosen = sample(options.count, options.seed, options.package)
    if options.list:
        print("\n".join(f"{each.key} {each.path}:{each.line} {each.operator}: {each.was} -> {each.becomes}" for each in chosen))
        return 0
    with tempfile.TemporaryDirectory(prefix="mutate-") as folder:
        tree = Tree(Path(folder), options.limit)
        for mutation in chosen:
            known = rows.get(mutation.key, {}).get("result")
            if known is None or (known == "survived" and options.survivors):
                begun = time.monotonic()
                found = tree.run(mutation)
                record({"key": mutation.key, **asdict(mutation), **found, "seconds": round(time.monotonic() - begun, 1)})
                print(f"{found['result']:9} {rows[mutation.key]['seconds']:6.1f} s  {mutation.path}:{mutation.line}  {mutation.was} -> {mutation.becomes}  [{found['test']}] {found['how']}", flush=True)
    print(report({each.key: rows[each.key] for each in chosen}))
    return 0


if __name__ == "__main__":
    sys.exit(main())

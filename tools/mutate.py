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
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONTRACT = "tests/contract tests/stages tests/selftest"
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
    "fidsplat/accuracy": ("tests/unit/test_budget.py tests/unit/test_accuracy.py", ""),
    "fidsplat/cameras": (f"{UNIT}/test_[clmt]*.py tests/contract/test_lens_pictures.py", "not warp"),
    "fidsplat/commands": (f"{UNIT} {EXPERIMENTS}", ""),
    "fidsplat/effects": (f"{UNIT} tests/compile tests/contract", "not warp"),
    "fidsplat/experiments": (f"{EXPERIMENTS} {UNIT}", ""),
    "fidsplat/formats": (f"{UNIT} {EXPERIMENTS}/test_dataset.py tests/selftest", "not warp"),
    "fidsplat/selftest": ("tests/selftest tests/contract/test_certificates.py", "not warp"),
    "fidsplat/logs": (f"{UNIT}/test_logs.py {UNIT}/test_flights.py", ""),
    "fidsplat/markers": (f"{UNIT}/test_[mv]*.py tests/contract/test_facets.py", "not warp"),
    "fidsplat/remote": (f"{UNIT}/test_remote*.py {UNIT}/test_flights.py", ""),
    "fidsplat/scenes": (f"{UNIT}/test_[sci]*.py", ""),
    "fidsplat/sim": (f"{UNIT} {EXPERIMENTS}/test_plants.py", ""),
    "fidsplat/store": (f"{UNIT}/test_s*.py {UNIT}/test_l*.py tests/contract/test_denser_splats.py", ""),
    "fidsplat/train": (f"{UNIT}/test_train*.py tests/contract/test_[tr]*.py", ""),
    "fidsplat/viewer": (f"{UNIT}/test_viewer*.py", ""),
    "fidsplat/vision": (f"{UNIT} {EXPERIMENTS}", ""),
}  # fmt: skip
MOST_FILES = 12
"""of tests for one mutation, the most fitting of the map"""
TEST_SECONDS = 20
"""of CPU time, after which a test hangs"""
LIMIT = -signal.SIGXCPU
INVALID = re.compile(
    r"BUILD_PROGRAM_FAILURE|clBuildProgram|Warp\w*Codegen\w*Error|Error while parsing function"
)

_LITERALS = r"""'''.*?'''|\"\"\".*?\"\"\"|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'"""
_SKIPPED = {
    ".py": rf"{_LITERALS}|\#[^\n]*|^\s*(?:@|from\s|import\s)[^\n]*",
    ".cl": rf"{_LITERALS}|//[^\n]*|/\*.*?\*/|^[ \t]*\#[ \t]*(?:if|elif|include|pragma|undef)[^\n]*",
}
_NUMBER = r"0[xX][\da-fA-F]+\w*|(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][+-]?\d+)?[fuUlL]*"
_OPERATOR = r"->|\*\*|<<=?|>>=?|//|&&|\|\||[-+*/<>=!&|^%]=|."
_TOKENS = {
    ending: re.compile(
        rf"(?P<skip>{skipped}|\s+|\\\n)|(?P<number>{_NUMBER})|(?P<name>[A-Za-z_]\w*)|(?P<op>{_OPERATOR})",
        re.DOTALL | re.MULTILINE,
    )
    for ending, skipped in _SKIPPED.items()
}
_PAIRS = {
    "axis": "width height, rows columns, row column, s0 s1, xy yx",
    "min/max": "min max, fmin fmax, minimum maximum, argmin argmax, amin amax, floor ceil, any all, sin cos",
    "logic": "and or, && ||",
    "sign": "+= -=, *= /=",
    "comparison": "< <=, > >=, < >, <= >=, == !=",
}
_KEYWORDS = {"return", "and", "or", "not", "in", "is", "if", "else", "elif", "while", "yield", "lambda"}
_SUMS, _PRODUCTS, _LOGIC = {"+", "-"}, {"*", "/", "%", "//", "**"}, {"and", "or", "&&", "||"}
_INSIDE = _SUMS | _PRODUCTS | {"<", ">", "<=", ">=", "==", "!=", "is", "in", "not"}


def _swaps() -> dict[str, list[tuple[str, str]]]:
    found: dict[str, list[tuple[str, str]]] = {}
    for operator, text in _PAIRS.items():
        for one, other in (pair.split(" ") for pair in text.split(", ")):
            found.setdefault(one, []).append((operator, other))
            found.setdefault(other, []).append((operator, one))
    return found


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

    def applied(self, source: str) -> str:
        return source[: self.start] + self.text + source[self.end :]


def edits(text: str, ending: str) -> Iterator[tuple[str, int, int, str]]:
    """All mutations of a source text: operator, start, end, replacement."""
    found = [m for m in _TOKENS[ending].finditer(text) if m.lastgroup != "skip"]
    words = ["", *(m.group() for m in found), "", ""]
    names = set(words)
    for i, m in enumerate(found, 1):
        before, word, after = words[i - 1 : i + 2]
        # whether an operand ends before this token
        binary = before in (")", "]", "}") or (re.match(r"[\w.]", before) and before not in _KEYWORDS)
        if m.lastgroup == "number":
            operator = "index" if before == "[" and after == "]" else "constant"
            yield from ((operator, *m.span(), other) for other in _other_numbers(word))
        swaps = SWAPS.get(word, [])
        if re.fullmatch(r"(?:\w+_)?[a-z]?[xy]", word):
            swaps = [("axis", word[:-1] + ("y" if word[-1] == "x" else "x"))]
        for operator, other in swaps:
            exists = operator != "axis" or other in names or before == "."
            if exists and (operator != "min/max" or after == "("):
                yield operator, *m.span(), other
        if word in _SUMS:
            yield "sign", *m.span(), ("-" if word == "+" else "+") if binary else " "
        if (word == "not" and before != "is" and after != "in") or (word == "!" and ending == ".cl"):
            yield "logic", *m.span(), ""
        if binary and word in _SUMS | _PRODUCTS | _LOGIC - {"**"}:
            last = _end_of_term(words, i + 1, word)
            yield "dropped term", m.start(), found[min(last, len(found)) - 1].end(), ""


def _end_of_term(words: list[str], at: int, operator: str) -> int:
    """Number of the last word of the operand that begins at `at`, with the operators that bind it tighter."""
    tighter = _INSIDE if operator in _LOGIC else _PRODUCTS if operator in _SUMS else {"**"}
    while at < len(words) - 2:
        while words[at] in ("-", "+", "!", "~", "not"):
            at += 1
        at = _end_of_group(words, at) if words[at] in ("(", "[", "{") else at + 1
        while words[at] in ("(", "[", "."):
            at = at + 2 if words[at] == "." else _end_of_group(words, at)
        if words[at] not in tighter:
            break
        at += 1
    return at - 1


def _end_of_group(words: list[str], at: int) -> int:
    depth = 0
    for at in range(at, len(words) - 1):  # noqa: B020
        depth += (words[at] in ("(", "[", "{")) - (words[at] in (")", "]", "}"))
        if depth == 0:
            break
    return at + 1


def _other_numbers(word: str) -> list[str]:
    digits = word.rstrip("fuUlL")
    suffix = word[len(digits) :]
    if word.lower().startswith("0x"):
        return []
    if digits.isdecimal() and "f" not in suffix:
        return [f"{other}{suffix}" for other in (int(digits) + 1, int(digits) - 1) if other >= 0]
    return [f"{1.25 * float(digits) or 0.5!r}{suffix}"]


SWAPS = _swaps()


def package_of(path: str) -> str:
    """Longest prefix in `TESTS`."""
    return max((name for name in TESTS if path.startswith(f"{name}/")), key=len, default="")


def mutations_of(file: Path) -> Iterator[Mutation]:
    """All mutations of a file, those that Python refuses included."""
    path, text = file.relative_to(ROOT).as_posix(), file.read_text("utf-8")
    for operator, start, end, other in edits(text, file.suffix):
        first, last = text.rfind("\n", 0, start) + 1, text.find("\n", end)
        was, becomes = text[first:last].strip(), (text[first:start] + other + text[end:last]).strip()
        line = text.count("\n", 0, start) + 1
        yield Mutation(package_of(path), path, line, operator, start, end, other, was, becomes)


def sample(count: int, seed: int, package: str) -> list[Mutation]:
    """Seeded mutations; a package's number grows with the square root of its source's size, and each operator
    of a package is as likely. The first `n` of a larger sample are the sample of `n`."""
    chance, weights, sites = random.Random(seed), Counter[str](), {}
    for file in sorted([*ROOT.glob("fidsplat/**/*.py"), *ROOT.glob("kernels/**/*.*")]):
        name = package_of(file.relative_to(ROOT).as_posix())
        if file.suffix in _TOKENS and file.name != "__init__.py" and package in name:
            weights[name] += file.stat().st_size
            for mutation in mutations_of(file):
                sites.setdefault(name, {}).setdefault(mutation.operator, []).append(mutation)
    drawn, chosen = dict.fromkeys(sites, 0), {}
    while sites and len(chosen) < count:
        name = min(drawn, key=lambda name: (drawn[name] + 1) / weights[name] ** 0.5)
        mutation = chance.choice(sites[name][chance.choice(sorted(sites[name]))])
        if mutation.key not in chosen and _is_python(mutation):
            chosen[mutation.key] = mutation
            drawn[name] += 1
    return list(chosen.values())


def _is_python(mutation: Mutation) -> bool:
    """Whether Python accepts the result; True for other languages."""
    file = ROOT / mutation.path
    with contextlib.suppress(SyntaxError):
        return file.suffix != ".py" or bool(ast.parse(mutation.applied(file.read_text("utf-8"))))
    return False


def tests_for(mutation: Mutation) -> list[str]:
    """Arguments of pytest: the files of the map that mention most often the words of the file's name, its
    public classes and functions."""
    patterns, expression = TESTS[mutation.package]
    first = 2 if mutation.path.startswith("kernels/") else 1
    words = [word for word in re.split(r"[_/.]", mutation.path)[first:-1] if len(word) > 2]
    words += re.findall(
        r"^(?:class|def) ([A-Za-z]\w+)", (ROOT / mutation.path).read_text("utf-8"), re.MULTILINE
    )
    places = [place for pattern in patterns.split() for place in sorted(ROOT.glob(pattern))]
    files = [
        file for place in places for file in sorted([place] if place.is_file() else place.rglob("test_*.py"))
    ]
    texts = {file.relative_to(ROOT).as_posix(): file.read_text("utf-8") for file in files}

    def mentions(name: str) -> int:
        return sum(min(texts[name].count(word), 8) + 9 * (word in name) for word in words)

    order = sorted(texts, key=mentions, reverse=True)
    return [*order[:MOST_FILES], *(["-k", expression] if expression else [])]


class Tree:
    """A copy of the working tree in which one mutation at a time is applied."""

    def __init__(self, folder: Path, limit: int) -> None:
        self._folder, self._limit = folder, limit
        self._passes: dict[str, bool] = {}
        command = ["git", "ls-files", "-coz", "--exclude-standard"]
        for name in subprocess.check_output(command, cwd=ROOT, text=True).split("\0"):
            if name and (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)

    def run(self, mutation: Mutation) -> tuple[str, str, str]:
        """`caught`, `survived` or `invalid` (it does not compile), the test that caught it, how it ended."""
        file, broken = self._folder / mutation.path, []
        text = file.read_text("utf-8")
        while True:
            file.write_text(mutation.applied(text), "utf-8")
            try:
                status, test, output = self._pytest([*tests_for(mutation), *broken])
            finally:
                file.write_text(text, "utf-8")
            if mutation.path.startswith("kernels/") and INVALID.search(output):
                return "invalid", test, ""
            if status in (0, LIMIT) or not test:
                return "survived", "", {0: "", LIMIT: "limit"}.get(status, f"pytest ended with {status}")
            if self._passes.setdefault(test, self._alone(test)):
                how = "fails" if status > 0 else "hangs" if status == -signal.SIGPROF else f"signal {-status}"
                return "caught", test, how
            broken += ["--deselect", test]  # it fails without the mutation, too

    def _alone(self, test: str) -> bool:
        """Whether a test, or the import of a test file, passes without the mutation."""
        return self._pytest([test, "-m", "", *([] if "::" in test else ["--collect-only"])])[0] == 0

    def _pytest(self, arguments: list[str]) -> tuple[int, str, str]:
        """Exit status, negative for a signal; the test that failed or was running; the output."""
        path = os.pathsep.join(str(self._folder / name) for name in (".", "tools"))
        environment = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "999"}
        options = ["-n", "0", "-x", "-v", "-p", "mutate", "-p", "no:cacheprovider"]
        limits = resource.RLIMIT_CPU, (self._limit, self._limit + 5)
        with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as stream:
            child = subprocess.Popen(
                [sys.executable, "-m", "pytest", *options, *arguments],
                cwd=self._folder, env=environment, stdout=stream, stderr=stream, start_new_session=True,
                preexec_fn=lambda: resource.setrlimit(*limits),
            )  # fmt: skip
            try:
                status = child.wait(10 * self._limit)
            except subprocess.TimeoutExpired:
                status = LIMIT
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(child.pid, signal.SIGKILL)
                child.wait()
            stream.seek(0)
            output = stream.read()
        failed = re.search(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", output, re.MULTILINE)
        outcome = r"(?: (?:PASSED|SKIPPED|FAILED|ERROR|Fatal)\b.*)?"
        begun = re.findall(rf"^(\S+\.py::.*?){outcome}$", output, re.MULTILINE)
        return status, failed[1] if failed else begun[-1].strip() if begun and status else "", output


def pytest_runtest_logstart() -> None:
    """End pytest by a signal when one test takes too long. This module is a plugin of the runs it starts."""
    signal.setitimer(signal.ITIMER_PROF, TEST_SECONDS)


def report(rows: dict[str, dict]) -> str:
    """Markdown: the score per package, then survivors and equivalent mutations."""
    lines = ["| package | caught | survived | equivalent | share |", "|---|---|---|---|---|"]
    for package in (*sorted({row["package"] for row in rows.values()}), "all"):
        results = [row["result"] for row in rows.values() if package in ("all", row["package"])]
        caught, survived, equivalent = (results.count(each) for each in ("caught", "survived", "equivalent"))
        share = f"{100 * caught / (caught + survived):.0f} %" if caught + survived else "-"
        lines.append(f"| {package} | {caught} | {survived} | {equivalent} | {share} |")
    for result in ("survived", "equivalent"):
        lines += ["", f"{result}:", *(_words(row) for row in rows.values() if row["result"] == result)]
    return "\n".join(lines)


def _words(row: dict) -> str:
    where = f"{row['path']}:{row['line']} ({row['operator']})"
    return f"- `{row['key']}` {where}: `{row['was']}` -> `{row['becomes']}` {row['test']} {row['how']}"


def main() -> int:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("--count", type=int, default=80, help="mutations of the sample")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--package", default="", help="only packages with this in their path")
    parser.add_argument("--limit", type=int, default=60, help="seconds of CPU time for a mutation's tests")
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
    elif options.survivors:
        paths = {row["path"]: row["key"] for row in rows.values() if row["result"] == "survived"}
        left = {key for key, row in rows.items() if row["result"] == "survived"}
        chosen = [one for path in paths for one in mutations_of(ROOT / path) if one.key in left]
        run({one.key: one for one in chosen}.values(), options.limit, record)
    elif not options.report:
        chosen = sample(options.count, options.seed, options.package)
        if options.list:
            print("\n".join(_words(_row(one, "", "")) for one in chosen))
            return 0
        run([one for one in chosen if one.key not in rows], options.limit, record)
    print(report(rows))
    return 0


def run(chosen: Iterable[Mutation], limit: int, record: Callable[[dict], None]) -> None:
    """Run mutations one after the other and record each result."""
    with tempfile.TemporaryDirectory(prefix="mutate-") as folder:
        tree = Tree(Path(folder), limit)
        for mutation in chosen:
            row = _row(mutation, *tree.run(mutation))
            record(row)
            print(row["result"], _words(row), flush=True)


def _row(mutation: Mutation, result: str, test: str, how: str = "") -> dict:
    return {"key": mutation.key, **asdict(mutation), "result": result, "test": test, "how": how}


if __name__ == "__main__":
    sys.exit(main())

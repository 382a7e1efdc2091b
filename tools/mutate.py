"""Mutation testing: inject one small bug at a time into a copy of the tree and run the tests that fit.

    python tools/mutate.py --count 80 --seed 7                run a seeded sample, spread over the packages
    python tools/mutate.py --package kernels/opencl --count 10   only of packages with this in their path
    python tools/mutate.py --list                             print the sample without running it
    python tools/mutate.py --survivors                        run survivors and those out of time again
    python tools/mutate.py --report                           print the score per package and the survivors
    python tools/mutate.py --equivalent KEY 'reason'          mark a survivor that changes no behaviour

Each result is a line of mutations.jsonl (the last line of a key holds), and a sample that was stopped resumes
there if the tree is the same. The operators work on tokens, so they are the same for Python, Warp kernels and
OpenCL C.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import hashlib
import json
import math
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
MOST_FILES = 12
"""Test files for one mutation."""
TEST_SECONDS = 20
"""CPU time after which a test hangs."""
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
    """Folder of a source file, at most two deep, three deep for backends and kernels."""
    parts = path.split("/")[:-1]
    return "/".join(parts[: 3 if parts[:2] in (["fidsplat", "backends"], ["kernels", "opencl"]) else 2])


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


def tests_for(mutation: Mutation, root: Path) -> list[str]:
    """Arguments of pytest: the test files most specific to the mutated place, the most specific first.

    root: the tree whose tests run, which may be older than the working tree.

    Similarity of word counts, weighted by how few test files contain a word. The words near the mutation, in
    the file's name and in its public names count more; an import of the mutated module doubles it.
    """
    path, source = mutation.path, (root / mutation.path).read_text("utf-8")
    warp = path.startswith(("kernels/warp/", "fidsplat/backends/warp/"))
    tests = {
        file.relative_to(root).as_posix(): file.read_text("utf-8") for file in root.glob("tests/*/test_*.py")
    }
    names = path.removesuffix(".py").split("/")
    imported = re.compile(
        rf"{'.'.join(names)}\b|from {'.'.join(names[:-1])} import [^\n]*\b{names[-1]}\b".replace(".", r"\.")
    )
    public = re.findall(r"^(?:class|def) ([A-Za-z]\w+)", source, re.MULTILINE)
    around = source[max(0, mutation.start - 600) : mutation.end + 600]
    texts = {name: Counter(_words_of(f"{name} {name} {text}")) for name, text in tests.items()}
    rarity = Counter(word for words in texts.values() for word in words)
    wanted = Counter(_words_of(source))
    for weight, text in ((4, around), (20, " ".join(names[1:])), (8, " ".join(public))):
        wanted.update({word: weight * count for word, count in Counter(_words_of(text)).items()})

    def similarity(name: str) -> float:
        words, weight = texts[name], lambda word: math.log(len(texts) / rarity[word])
        vector = {word: math.log1p(count) * weight(word) for word, count in words.items()}
        common = sum(
            math.log1p(wanted[word]) * weight(word) * vector[word] for word in wanted if word in words
        )
        length = math.sqrt(sum(value * value for value in vector.values())) or 1.0
        return common / length * (2 if imported.search(tests[name]) else 1)

    order = sorted(tests, key=similarity, reverse=True)
    if path.startswith("kernels/") or "/backends/" in path:
        order = [name for name in order if warp or "warp" not in name]
    return [*order[:MOST_FILES], "-k", "warp or not opencl" if warp else "not warp"]


def _words_of(text: str) -> list[str]:
    return re.findall(r"[a-z]{3,}", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text).lower())


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
        """Result, the test that caught the mutation, and how that test ended.

        The result is `caught`, `survived`, `limit` (time is up and no test has failed) or `invalid` (it does
        not compile).
        """
        file, broken = self._folder / mutation.path, []
        turn, turns = 0, [1, 4, 5]  # all devices and all cases (tests/sampling.py)
        text = file.read_text("utf-8")
        while True:
            file.write_text(mutation.applied(text), "utf-8")
            try:
                status, test, output = self._pytest(
                    ["--turn", str(turn), *tests_for(mutation, self._folder), *broken]
                )
            finally:
                file.write_text(text, "utf-8")
            if mutation.path.startswith("kernels/") and INVALID.search(output):
                return "invalid", test, ""
            if status == LIMIT:
                return "limit", test, f"{self._limit} s of CPU time"
            if status in (0, 5) and turns:
                turn = turns.pop(0)
                continue
            if status in (0, 5):  # 5: no test is left
                return "survived", "", ""
            if "ImportError while loading conftest" in output:
                return "caught", "tests/conftest.py", "fails"
            if not test:
                raise RuntimeError(f"pytest ended with {status}:\n{output[-2000:]}")
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
        cache = str(self._folder / ".pycache")  # kernels are cached where the user's are: most do not change
        environment = os.environ | {"PYTHONPATH": path, "PYTHONPYCACHEPREFIX": cache, "COLUMNS": "999"}
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
    """Markdown: the score per package, then survivors, mutations out of time and equivalent ones.

    The share is caught / (caught + survived).
    """
    lines = ["| package | caught | survived | limit | equivalent | share |", "|---|---|---|---|---|---|"]
    for package in (*sorted({row["package"] for row in rows.values()}), "all"):
        results = [row["result"] for row in rows.values() if package in ("all", row["package"])]
        caught, survived, limit, equivalent = map(
            results.count, ("caught", "survived", "limit", "equivalent")
        )
        share = f"{100 * caught / (caught + survived):.0f} %" if caught + survived else "-"
        lines.append(f"| {package} | {caught} | {survived} | {limit} | {equivalent} | {share} |")
    for result in ("survived", "limit", "equivalent"):
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
    parser.add_argument("--limit", type=int, default=300, help="seconds of CPU time for a mutation's tests")
    parser.add_argument("--results", type=Path, default=Path("mutations.jsonl"))
    parser.add_argument("--survivors", action="store_true", help="run survivors and those out of time again")
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
        left = {key: row["path"] for key, row in rows.items() if row["result"] in ("survived", "limit")}
        chosen = [one for path in set(left.values()) for one in mutations_of(ROOT / path) if one.key in left]
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

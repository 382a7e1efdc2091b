"""mkdocs hook: publish the notebooks of examples/ as pages; devlog/ and Splatmark outside the navigation."""

import json
import sys
from pathlib import Path

from mkdocs.structure.files import File

TREE = Path(__file__).parents[1]
sys.path[:0] = [str(TREE), str(TREE / "benchmarks")]

import splatmark  # noqa: E402


def notebook_page(path):
    """Markdown of a notebook: its text cells, and its code cells as Python blocks."""
    cells = json.loads(path.read_text("utf-8"))["cells"]
    texts = (("".join(cell["source"]), cell["cell_type"]) for cell in cells)
    return "\n\n".join(text if kind == "markdown" else f"```python\n{text}\n```" for text, kind in texts)


def on_files(files, config):
    """Add every file of devlog/, a page per notebook, and Splatmark with its results."""
    results = sorted((TREE / "benchmarks" / "results").glob("suite-*.json"))
    files.append(File.generated(config, "splatmark/index.html", content=splatmark.page(results)))
    for path in results:
        files.append(File.generated(config, f"splatmark/{path.name}", abs_src_path=str(path)))
    for path in sorted((TREE / "devlog").rglob("*.*")):
        files.append(File.generated(config, path.relative_to(TREE).as_posix(), abs_src_path=str(path)))
    for path in sorted((TREE / "examples" / "notebooks").glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=notebook_page(path)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Convert links from docs/ to devlog/ and results in the tree, and back, to links of the site."""
    if page.file.src_uri.startswith("devlog/"):
        return markdown.replace("](../docs/", "](../")
    return markdown.replace("](../devlog/", "](devlog/").replace(
        "](../benchmarks/results)", "](splatmark/index.html)"
    )

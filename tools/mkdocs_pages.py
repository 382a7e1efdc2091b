"""mkdocs hook: publish the notebooks of examples/ as pages, and devlog/ outside the navigation."""

import json
from pathlib import Path

from mkdocs.structure.files import File

TREE = Path(__file__).parents[1]


def notebook_page(path):
    """Markdown of a notebook: its text cells, and its code cells as Python blocks."""
    cells = json.loads(path.read_text("utf-8"))["cells"]
    texts = (("".join(cell["source"]), cell["cell_type"]) for cell in cells)
    return "\n\n".join(text if kind == "markdown" else f"```python\n{text}\n```" for text, kind in texts)


def on_files(files, config):
    """Add every file of devlog/ and a page per notebook."""
    for path in sorted((TREE / "devlog").rglob("*.*")):
        files.append(File.generated(config, path.relative_to(TREE).as_posix(), abs_src_path=str(path)))
    for path in sorted((TREE / "examples" / "notebooks").glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=notebook_page(path)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Convert links between docs/ and devlog/ in the tree to links of the site."""
    if page.file.src_uri.startswith("devlog/"):
        return markdown.replace("](../docs/", "](../")
    return markdown.replace("](../devlog/", "](devlog/")

"""mkdocs hook: publish devlog/ with the site, outside its navigation."""

from pathlib import Path

from mkdocs.structure.files import File

DEVLOG = Path(__file__).parents[1] / "devlog"


def on_files(files, config):
    """Add every file of devlog/ to the site's files."""
    for path in sorted(DEVLOG.rglob("*.*")):
        name = path.relative_to(DEVLOG.parent).as_posix()
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Turn links between docs/ and devlog/, neighbours in the tree, into links of the site."""
    if page.file.src_uri.startswith("devlog/"):
        return markdown.replace("](../docs/", "](../")
    return markdown.replace("](../devlog/", "](devlog/")

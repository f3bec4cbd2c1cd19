"""MkDocs hook: files outside docs/ that a page links to become part of the site.

A page may link to any file of the repository by a relative path (`../config/node.yaml`), as GitHub
shows it. The site gets a copy of the file under `repository/`, and the link leads there.
"""

from __future__ import annotations

from pathlib import Path
import re

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

#: a Markdown link that leaves docs/, up to the path's end
_LINK = re.compile(r'(\]\()\.\./([^)#\s]+)')
#: a picture that lies beside the page that shows it
_PICTURE = re.compile(r'!\[[^\]]*\]\(([^)/:]+)\)')
_FOLDER = 'repository'


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files that pages link to; a missing one is left to MkDocs' own check of links."""
    root = Path(config.docs_dir).parent
    texts = [page.content_string for page in files.documentation_pages()]
    names = {match[2] for text in texts for match in _LINK.finditer(text)}
    for name in [name for name in names if name.endswith('.md') and (root / name).is_file()]:
        shown = _PICTURE.findall((root / name).read_text())
        names.update(str(Path(name).with_name(picture)) for picture in shown)
    for name in sorted(names):
        if (root / name).is_file():
            source = str(root / name)
            files.append(File.generated(config, f'{_FOLDER}/{name}', abs_src_path=source))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: object) -> str:
    """Point the links to the copies, and those of copied pages back into docs/."""
    source = page.file.src_uri
    if source.startswith(_FOLDER):  # one folder deeper than in the repository
        up = '../' * (source.count('/') - 1)
        return markdown.replace(f']({up}docs/', f']({up}../')
    return _LINK.sub(rf'\1{_FOLDER}/\2', markdown)

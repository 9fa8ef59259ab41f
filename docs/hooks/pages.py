"""What the site is given while it is built: the help of every command, and diagrams that follow the theme.

MkDocs calls the functions named ``on_...``. Nothing here is copied text: the help comes from the commands themselves.
"""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
COMMANDS_PLACE = "<!-- the help of every command -->"
HELP_WIDTH = 80  # columns: fits the page
DIAGRAM = re.compile(r'<img alt="(?P<alt>[^"]*)" src="(?P<src>[^"]*\.svg)"[^>]*>')


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Puts the help of every command where the page asks for it."""
    return markdown.replace(COMMANDS_PLACE, commands_help()) if COMMANDS_PLACE in markdown else markdown


def on_page_content(html: str, *, page: Any, config: Any, **_: Any) -> str:
    """Puts SVG files into the page itself, so that their colours are those of the theme, light or dark."""
    folder = (Path(config["docs_dir"]) / page.file.src_uri).parent

    def inline(found: re.Match[str]) -> str:
        svg = (folder / found["src"]).read_text()
        drawn = svg.replace("<svg ", f'<svg role="img" aria-label="{found["alt"]}" ', 1)
        return f'<span class="diagram">{drawn}</span>'

    return DIAGRAM.sub(inline, html)


def commands_help() -> str:
    """A section for each command: what it is for, and what ``segvisrl COMMAND --help`` prints."""
    sys.path.insert(0, str(ROOT))
    from segvisrl_jax.cli import COMMANDS

    sections = [
        f"## segvisrl {name}\n\n{what[0].upper()}{what[1:]}.\n\n```text\n{help_of(name)}\n```"
        for name, what in COMMANDS.items()
    ]
    return "\n\n".join(sections)


def help_of(command: str) -> str:
    """What ``segvisrl COMMAND --help`` prints, without colours."""
    environment = os.environ | {"COLUMNS": str(HELP_WIDTH), "NO_COLOR": "1", "TERM": "dumb", "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-m", "segvisrl_jax.cli", command, "--help"]
    said = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    return said.stdout.strip()

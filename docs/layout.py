"""Hooks of MkDocs: names in code are not broken at hyphens, and reports have no table of contents beside them."""

import re
from typing import Any

CODE = re.compile(r"(<pre\b.*?</pre>)|<code>([^<]*)</code>", re.DOTALL)
LONGEST = 32  # characters of a name that a phone shows in a line


def on_page_content(content: str, **_: Any) -> str:
    """Keep each short word of inline code in one line: a browser breaks `--delay` behind its hyphens."""
    return CODE.sub(lambda match: match[1] or f"<code>{_kept(match[2])}</code>", content)


def _kept(code: str) -> str:
    words = re.findall(r"\s+|\S+", code)
    return "".join(f'<span class="word">{w}</span>' if "-" in w and len(w) <= LONGEST else w for w in words)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Hide the table of contents of generated reports, whose tables need its width."""
    if page.file.src_uri.startswith("results/"):
        page.meta["hide"] = ["toc"]
    return markdown

#!/usr/bin/env python3
"""Checks the links of the book: every page of docs/ is in SUMMARY.md, every linked file and heading exists."""

import pathlib
import re
import sys

DOCS = pathlib.Path(__file__).resolve().parents[1]
ROOT = DOCS.parent


def body(page):
    """Returns the text of a page without fenced blocks and inline code."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M)
    return re.sub(r"`[^`\n]*`", lambda code: code.group(0)[1:-1].replace("[", "").replace("]", ""), text)


def anchors(page):
    """Returns the anchors of the headings of a page, as GitHub and mdbook make them."""
    found = set()
    for heading in re.findall(r"^#+ +(.*)$", body(page), flags=re.M):
        heading = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        found.add(re.sub(r"[^\w\- ]", "", heading).replace(" ", "-"))
    return found


def main():
    problems = []
    pages = sorted(DOCS.rglob("*.md")) + [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
    for page in pages:
        for target in re.findall(r"\]\(([^)\s]+)\)", body(page)):
            if re.match(r"[a-z]+:", target):
                continue
            path, _, anchor = target.partition("#")
            file = (page.parent / path).resolve() if path else page
            if not file.exists():
                problems.append(f"{page.relative_to(ROOT)}: {target}: no such file")
            elif anchor and file.suffix == ".md" and anchor not in anchors(file):
                problems.append(f"{page.relative_to(ROOT)}: {target}: no such heading")
    summary = DOCS / "SUMMARY.md"
    links = [(DOCS / target).resolve() for target in re.findall(r"\]\(([^)\s]+)\)", body(summary))]
    listed = set(links)
    for page in sorted(page for page in listed if links.count(page) > 1):
        problems.append(f"{page.relative_to(DOCS)} is in docs/SUMMARY.md more than once. mdbook refuses that: keep one.")
    for page in DOCS.rglob("*.md"):
        if page != summary and page not in listed:
            problems.append(f"{page.relative_to(ROOT)} is not in docs/SUMMARY.md. Add it to one of the four parts.")
    print("\n".join(problems) if problems else f"{len(pages)} pages: every link and every heading exists")
    sys.exit(bool(problems))


if __name__ == "__main__":
    main()

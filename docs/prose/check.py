#!/usr/bin/env python3
"""Checks the prose of Planish: `just prose`, or docs/prose/check.py [--only PATH...] [--harper] [--summary].

It prints one line per finding, with file, line, count of words and text, and exits with code 1 if it finds anything:

- sentences of more than 30 words, and paragraphs, bullets or table cells of more than 100 words, in Markdown pages,
- doc comments and descriptions of flags that begin without a subject ("Whether", "By how much", "What"),
- with --harper, words that Harper (package harper-py) does not know and docs/prose/words.txt does not list, and words
  that are repeated.

Code blocks, HTML comments, headings and numbers in tables are not sentences. `Inline code` and a link's address count as
one word.
"""

import argparse
import pathlib
import re
import sys

MAX_SENTENCE = 30
MAX_PARAGRAPH = 100
MAX_PAGE = 2500
MAX_BOOK = 50000

ROOT = pathlib.Path(__file__).resolve().parents[2]
WORDS = pathlib.Path(__file__).resolve().parent / "words.txt"

# Pages and sources that the checks read, as patterns below the root.
PAGES = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/**/*.md"]
SOURCES = ["crates/*/src/**/*.rs"]

# Pages that nobody reads from top to bottom: lists that a command writes, decisions and changes.
LISTS = re.compile(r"(docs/(programs|formats|SUMMARY|decisions/.*)|CHANGELOG|CONTRIBUTING)\.md$")

# A full stop after one of these does not end a sentence.
ABBREVIATIONS = set(
    """e.g i.e et al etc cf vs eq eqs fig figs no nos sec ch vol p pp ca approx resp st dr prof incl excl max min
    opt j int appl proc trans phys lett math comput mech tech precis eng mater sci am soc ind numer anal acta rev
    ann conf ed eds manuf""".split()
)

# First words of a fragment, whatever follows.
HEADLESS = set("what whether how which why that of who whose so than and or but nor".split())
# First words of a fragment, unless a comma ends the clause: "With `--fit`, the program ...".
HEADLESS_WITHOUT_COMMA = set(
    """by as where for from at in on to with without if when while until because after before below above beside
    between beyond through instead""".split()
)
# First words of a fragment, although a comma may follow.
HEADLESS_PHRASES = re.compile(
    r"^(by how|by what|by which|as (long|far|many|much|often|soon)|for (how|what|which)|to (what|which)|"
    r"in (which|what)|from (which|what|where)|with (what|which)|at (what|which))\b",
    re.I,
)
# Noun phrases that begin like a fragment.
NOT_HEADLESS = re.compile(r"^(at (most|least)|so-called|in-plane|on-axis|that of)\b|^to-", re.I)


class Text:
    """A piece of prose: where it begins, and its words without markup."""

    def __init__(self, path, line, text, kind):
        self.path, self.line, self.text, self.kind = path, line, text, kind


def plain(text):
    """The text without Markdown markup; inline code and addresses become one word."""
    text = re.sub(r"<!--.*?-->", " ", text, flags=re.S)
    text = re.sub(r"!\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"(`+)(.+?)\1", "`code`", text, flags=re.S)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"\[([^\]]+)\](\[[^\]]*\])?", r"\1", text)
    text = re.sub(r"<?https?://\S+", "address", text)
    text = re.sub(r"<[^>\s][^>]*>", " ", text)
    text = re.sub(r"(\*\*|__|(?<!\w)[*_](?=\w)|(?<=\w)[*_](?!\w))", "", text)
    return re.sub(r"\s+", " ", text).strip()


def words(text):
    """The words of a plain text: tokens with a letter or a digit."""
    return [token for token in text.split() if re.search(r"[^\W_]", token)]


def sentences(text):
    """The sentences of a plain text."""
    found, start = [], 0
    for end in re.finditer(r"[.!?][\"')\]]*\s+(?=[\"'(\[`]*[A-Z0-9`])", text):
        before = text[start : end.start()].split()
        last = before[-1].strip("(\"'[").lower() if before else ""
        if text[end.start()] == "." and (last in ABBREVIATIONS or re.fullmatch(r"(\w\.)*[a-z]", last)):
            if not (len(last) == 1 and before[-1].islower()):
                continue
        found.append(text[start : end.end()].strip())
        start = end.end()
    found.append(text[start:].strip())
    return [sentence for sentence in found if sentence]


def markdown(path):
    """The paragraphs, bullets and table cells of a page."""
    pieces, current = [], None
    fence = None
    comment = False

    def close():
        nonlocal current
        if current and current.text.strip():
            pieces.append(current)
        current = None

    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        stripped = line.strip()
        mark = re.match(r"(```+|~~~+)", stripped)
        if fence:
            if mark and stripped.startswith(fence) and not stripped.strip("`~"):
                fence = None
            continue
        if mark:
            close()
            fence = mark.group(1)
            continue
        if comment or stripped.startswith("<!--"):
            close()
            comment = "-->" not in stripped
            continue
        if not stripped or stripped.startswith("#") or re.fullmatch(r"[-=*_]{3,}", stripped):
            close()
            continue
        if stripped.startswith("|"):
            close()
            if not re.fullmatch(r"[|:\-\s]+", stripped):
                for cell in re.split(r"(?<!\\)\|", stripped.strip("|")):
                    if re.search(r"[A-Za-z]{2}", cell):
                        pieces.append(Text(path, number, cell, "cell"))
            continue
        bullet = re.match(r"(?:[-*+]|\d+[.)])\s+(.*)", stripped)
        if bullet:
            close()
            current = Text(path, number, bullet.group(1), "bullet")
        elif current:
            current.text += "\n" + stripped.removeprefix("> ")
        elif not line.startswith("    "):
            current = Text(path, number, stripped.removeprefix("> "), "paragraph")
    close()
    return pieces


def doc_comments(path):
    """The doc comments of a source file, and the texts of `help` and `about`: the first line, and all of the text."""
    found, current = [], None
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        comment = re.match(r"\s*//[/!](?!/)\s?(.*)", line)
        if comment:
            if current is None:
                current = Text(path, number, "", "doc comment")
                found.append(current)
            current.text += comment.group(1) + "\n"
            continue
        current = None
        for described in re.finditer(r"\b(?:long_)?(?:help|about)\s*=\s*\"((?:[^\"\\]|\\.)*)\"", line):
            found.append(Text(path, number, described.group(1), "description"))
    return found


def is_headless(text):
    """Returns True if a doc comment begins with a word that makes its first sentence a fragment."""
    first = sentences(plain(text.strip().split("\n\n")[0]))
    if not first:
        return False
    start = first[0]
    word = re.match(r"[\"'(]*([A-Za-z]+)", start)
    if not word or NOT_HEADLESS.match(start):
        return False
    word = word.group(1)
    if not word[0].isupper():
        return False
    word = word.lower()
    if word in HEADLESS or HEADLESS_PHRASES.match(start):
        return True
    return word in HEADLESS_WITHOUT_COMMA and not re.search(r", \S+ \S+", start)


def percentile(values, part):
    """Returns the value that this part of the values does not exceed."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(part * len(ordered)))] if ordered else 0


def book(pages):
    """The words of README.md and of the pages of the book but for LISTS, without code blocks, by page, the longest first."""
    read = [page for page in pages if not LISTS.search(page.resolve().as_posix())]
    texts = [re.sub(r"```.*?```|<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.S) for page in read]
    return sorted(((len(words(text)), str(short(page))) for page, text in zip(read, texts)), reverse=True)


def files(only):
    """The pages and the sources, all of them or those below the paths of --only."""
    pages = sorted({path for pattern in PAGES for path in ROOT.glob(pattern)})
    sources = sorted({path for pattern in SOURCES for path in ROOT.glob(pattern)})
    if not only:
        return pages, sources
    chosen_pages, chosen_sources = [], []
    for name in only:
        given = pathlib.Path(name)
        if not given.exists():
            sys.exit(f"check.py: {name} does not exist. Give a page, a source file or a folder.")
        for path in [given] if given.is_file() else sorted(given.rglob("*")):
            if path.suffix == ".md":
                chosen_pages.append(path)
            elif path.suffix == ".rs":
                chosen_sources.append(path)
    return chosen_pages, chosen_sources


def short(path):
    """The path as it is printed."""
    try:
        return path.resolve().relative_to(pathlib.Path.cwd())
    except ValueError:
        return path


# Kinds of Harper's findings that count. Its other rules misread units ("3 s in", "5 um") and formulas.
HARPER_KINDS = {"Spelling": "unknown word, or one for docs/prose/words.txt", "Repetition": "repeated word"}


def harper_findings(pieces):
    """Returns what Harper finds in the pieces, one line each, or None without the package harper-py."""
    try:
        from harper import Dialect, Linter
    except ImportError:
        return None
    linter = Linter(dialect=Dialect.BRITISH)
    linter.import_words([word for word in WORDS.read_text(encoding="utf-8").split("\n") if word and word[0] != "#"])
    found = []
    for path in sorted({piece.path for piece in pieces}):
        here = [(piece, plain(piece.text)) for piece in pieces if piece.path == path]
        text, starts = "", []
        for piece, part in here:
            starts.append((len(text), piece))
            text += part + "\n\n"
        for lint in linter.lint(text):
            # Short tokens are symbols and units; tokens with digits are names.
            symbol = len(lint.problem_text) <= 2 or re.search(r"[\d.]", lint.problem_text)
            if lint.lint_kind not in HARPER_KINDS or (lint.lint_kind == "Spelling" and symbol):
                continue
            piece = [piece for start, piece in starts if start <= lint.span.start][-1]
            around = text[max(0, lint.span.start - 40) : lint.span.end + 40].replace("\n", " ").strip()
            found.append(
                f"{short(path)}:{piece.line}: {HARPER_KINDS[lint.lint_kind]}: {lint.problem_text} (... {around} ...)"
            )
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="PATH", help="pages, source files or folders to check, instead of all")
    parser.add_argument("--summary", action="store_true", help="print the measures only")
    parser.add_argument("--harper", action="store_true", help="also check spelling and repetitions by Harper")
    parser.add_argument("--report", action="store_true", help="exit with code 0 although something was found")
    arguments = parser.parse_args()
    pages, sources = files(arguments.only)

    findings, lengths, paragraphs = [], [], []
    pieces = [piece for page in pages for piece in markdown(page)]
    for piece in pieces:
        text = plain(piece.text)
        count = len(words(text))
        place = f"{short(piece.path)}:{piece.line}"
        paragraphs.append((count, place))
        if count > MAX_PARAGRAPH:
            findings.append(f"{place}: {piece.kind} of {count} words: {text[:80]}...")
        for sentence in sentences(text):
            length = len(words(sentence))
            lengths.append((length, place))
            if length > MAX_SENTENCE:
                findings.append(f"{place}: sentence of {length} words: {sentence}")
    comments = [comment for source in sources for comment in doc_comments(source)]
    headless = [comment for comment in comments if is_headless(comment.text)]
    for comment in headless:
        first = sentences(plain(comment.text.strip().split("\n\n")[0]))[0]
        findings.append(
            f"{short(comment.path)}:{comment.line}: headless {comment.kind}, {len(words(first))} words: {first}"
        )
    if arguments.harper:
        found = harper_findings(pieces)
        if found is None:
            print("harper-py is not installed: spelling was not checked")
        else:
            findings += found

    if not arguments.summary:
        print("\n".join(findings))
    if lengths:
        longest, paragraph = max(lengths), max(paragraphs)
        print(f"sentences: {len(lengths)}, 90th percentile {percentile([n for n, _ in lengths], 0.9)} words (goal 24), "
              f"longest {longest[0]} words at {longest[1]} (goal {MAX_SENTENCE})")
        print(f"sentences of more than {MAX_SENTENCE} words: {sum(n > MAX_SENTENCE for n, _ in lengths)}")
        print(f"longest paragraph, bullet or cell: {paragraph[0]} words at {paragraph[1]} (goal {MAX_PARAGRAPH})")
    counts = book(pages)
    if counts:
        print(f"words of {len(counts)} pages without code: {sum(count for count, _ in counts)} (goal {MAX_BOOK}), "
              f"longest page {counts[0][0]} at {counts[0][1]} (goal {MAX_PAGE})")
    if comments:
        print(f"headless doc comments and flag descriptions: {len(headless)} of {len(comments)} (goal 0)")
    print(f"findings: {len(findings)}")
    if findings and not arguments.report:
        sys.exit(1)


if __name__ == "__main__":
    main()

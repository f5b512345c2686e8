"""Runs the commands that print the tables of the pages, and compares every row that a page or its CSV file shows.

    just test-tables                     all of them; hours
    just test-tables line axes           those whose command has one of these words

A table of a page belongs to a command if its columns are the first ones that the command prints. Each of its rows must be
one of the printed rows: the same words, and numbers within 1 % or two units of the last digit that the page shows. That
much differs between two processors, see crates/testkit/tests/commands_as_printed.rs. Ends with 1 and the rows that are
stale, or where a command prints no table of its pages.
"""

import csv
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Commands, the pages that show their tables, and the folder of their results, which is made anew: what is there already
# may be of an older program.
TABLES = {
    "just line-table": (["docs/lines.csv"], "out/lines"),
    "just axes-table": (["docs/axes.md"], "out/axes-table"),
    "just paths-table": (["docs/paths.md", "docs/joint-paths.csv"], "out/paths-table"),
    "just joint-table mirror": (["docs/joint.md"], None),
    "just joint-table jerk": (["docs/joint.md"], None),
    "just joint-table servo": (["docs/joint.md"], None),
    "just joint-table fixtures": (["docs/joint.md"], None),
    "just refine-table": (["docs/refine.md", "docs/refine-mirror.csv", "docs/refine-schedulers.csv", "docs/refine-noise.csv"], None),
    "just mode-table": (["docs/decisions/0071-pvt-mode-over-fixtures.md"], None),
    "just programs-table": (["docs/controller-programs.md", "docs/controller-programs-plans.csv"], "out/programs"),
    "just programs-table --axes": (["docs/controller-programs-axes.csv"], "out/programs"),
    "just programs-table --grids": (["docs/controller-programs-grids.csv"], "out/programs"),
}
# Commands that need the reference mirror.
OF_THE_MIRROR = {"just paths-table", "just joint-table mirror", "just joint-table jerk", "just joint-table servo",
                 "just refine-table", "just programs-table --grids"}
RELATIVE = 1e-2
LAST_DIGITS = 2.0
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def cells(line):
    return [cell.strip().replace("`", "") for cell in line.strip().strip("|").split("|")]


def tables(text):
    """The tables of a text: columns and rows of cells."""
    found, lines = [], text.splitlines()
    for i, line in enumerate(lines[:-1]):
        if line.startswith("|") and re.fullmatch(r"[|: -]+", lines[i + 1].strip()):
            rows = []
            for row in lines[i + 2:]:
                if not row.startswith("|"):
                    break
                rows.append(cells(row))
            found.append((cells(line), rows))
    return found


def tables_of(page):
    """The tables of a page, or the table of a CSV file: columns and rows of cells."""
    if page.suffix == ".csv":
        with page.open(encoding="utf-8", newline="") as file:
            columns, *rows = csv.reader(file)
        return [(columns, rows)]
    return tables(page.read_text(encoding="utf-8"))


def same_number(shown, printed):
    decimals = len(shown.partition("e")[0].partition(".")[2])
    last = 10.0 ** -decimals if "e" not in shown else 10.0 ** (int(shown.partition("e")[2]) - decimals)
    most = max((LAST_DIGITS + 1e-3) * last, RELATIVE * abs(float(shown)))
    return abs(float(shown) - float(printed)) <= most


def same_row(shown, printed):
    shown, printed = (" | ".join(row) for row in (shown, printed[:len(shown)]))
    if NUMBER.sub("#", shown) != NUMBER.sub("#", printed):
        return False
    return all(map(same_number, NUMBER.findall(shown), NUMBER.findall(printed)))


def compare(command, pages, folder):
    """The number of rows that agree, and a sentence for each thing that does not."""
    if folder:
        shutil.rmtree(ROOT / folder, ignore_errors=True)
    done = subprocess.run(shlex.split(command), cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        return 0, [f"`{command}` ends with {done.returncode}: {done.stderr[-2000:]}"]
    printed = tables(done.stdout)
    agree, wrong, shown_tables = 0, [], 0
    for page in pages:
        for columns, rows in tables_of(ROOT / page):
            mine = [r for c, r in printed if c[:len(columns)] == columns]
            if not mine:
                continue
            of_command = [row for rows in mine for row in rows]
            # Another command may print other rows below the same columns.
            if not {row[0] for row in rows} & {row[0] for row in of_command}:
                continue
            shown_tables += 1
            for row in rows:
                if any(same_row(row, other) for other in of_command):
                    agree += 1
                    continue
                near = [other for other in of_command if other[0] == row[0]]
                wrong.append(f"{page}, `{command}`:\n  | {' | '.join(row)} |\n" + "".join(
                    f"  printed: | {' | '.join(other)} |\n" for other in near))
    if shown_tables == 0:
        wrong.append(f"`{command}` prints no table of {', '.join(pages)}")
    return agree, wrong


def main():
    words = sys.argv[1:]
    failures = []
    for command, (pages, folder) in TABLES.items():
        if words and not any(word in command.split() or f"{word}-table" in command for word in words):
            continue
        if command in OF_THE_MIRROR and not os.environ.get("PLANISH_REFERENCE"):
            print(f"{command}: left out, it needs PLANISH_REFERENCE")
            continue
        agree, wrong = compare(command, pages, folder)
        print(f"{command}: {agree} rows agree, {len(wrong)} do not", flush=True)
        failures += wrong
    if failures:
        sys.exit("\n".join(failures))


if __name__ == "__main__":
    main()

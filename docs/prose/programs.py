#!/usr/bin/env python3
"""Prints docs/programs.md from the descriptions of the programs: programs.py target/release > docs/programs.md."""

import json
import pathlib
import subprocess
import sys


# Flags of every command.
EVERYWHERE = {
    "--help": "Flags with units, defaults and examples",
    "--quiet": "Print only warnings, verdicts and errors",
    "--json": "Print the outcome as one JSON object, and nothing else on standard output",
    "--memory-gib GIB": "Memory that the program may take, GiB: it refuses what needs more (8)",
    "--version": "Version",
    "--man": "Manual page in roff: `planish dwell --man \\| man -l -`",
    "--completions SHELL": "Completion script for bash, zsh, fish, elvish or powershell",
    "--describe": "Flags as JSON",
}


def cell(text):
    """Returns a text as a cell of a table. Names in angle brackets are no HTML."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def heading(text):
    """Returns the description of a program or a command with lines of at most 120 characters."""
    lines = []
    for paragraph in text.strip().split("\n\n"):
        line = ""
        for word in paragraph.split():
            if line and len(line) + 1 + len(word) > 120:
                lines.append(line)
                line = word
            else:
                line = f"{line} {word}".strip()
        lines += [line, ""]
    return "\n".join(lines).strip()


def main():
    print("# Programs\n")
    print("This page lists every program, command and flag, for looking up. `just docs` writes it from `--describe`.\n")
    print("```sh\nplanish verify --help\n```\n")
    print("Every command also takes these flags. `planish-verify` is a second name of `planish verify`, and so on.\n")
    print("| flag | description |\n|---|---|")
    for flag, description in EVERYWHERE.items():
        print(f"| `{flag}` | {description} |")
    crates = pathlib.Path(__file__).resolve().parents[2] / "crates"
    names = sorted(f"planish-{main.parents[1].name}" for main in crates.glob("*/src/command.rs"))
    programs = [pathlib.Path(sys.argv[1]) / name for name in names]
    for program in programs:
        described = subprocess.run([program, "--describe"], check=True, capture_output=True, text=True)
        about = json.loads(described.stdout)
        called = about["program"].replace("-", " ", 1)
        print(f"\n## {called}\n\n{heading(about['about'])}")
        for command in about["commands"]:
            if command["name"]:
                # The commands of planish-run need no `run` before them.
                before = "planish" if about["program"] == "planish-run" else called
                print(f"\n### {before} {command['name']}\n\n{heading(command['about'])}")
                if command["baseline"]:
                    print("\nA baseline, to compare with the literature; a report never recommends its plan.")
            if command["about"].startswith("Second name of "):
                continue
            flags = [flag for flag in command["flags"] if flag["name"] not in ("help", "version", "memory-gib")]
            if not flags:
                continue
            print("\n| flag | default | description |\n|---|---|---|")
            for flag in flags:
                name = flag["name"] if flag["positional"] else f"--{flag['name']}"
                value = f" {flag['value']}" if flag["value"] and not flag["positional"] else ""
                default = "required" if flag["required"] else (f"`{cell(str(flag['default']))}`" if flag["default"] else "-")
                choices = [c if isinstance(c, str) else c["name"] for c in flag["choices"]]
                named = ", ".join(f"`{choice}`" for choice in choices)
                chosen = f". One of {named}" if choices else ""
                print(f"| `{name}{value}` | {default} | {cell((flag['help'] or '') + chosen)} |")


if __name__ == "__main__":
    main()

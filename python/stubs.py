#!/usr/bin/env python3
"""Prints the types of the stage functions, from the descriptions of the programs.

    stubs.py target/release/planish > python/planish/_stages.pyi

An editor completes and a type checker checks by this file, which the wheel contains (wheel_build.py). The functions
themselves are made when Python runs.
"""

import json
import keyword
import pathlib
import re
import subprocess
import sys
import textwrap

# Commands that write several artifacts: their function returns a dict of them.
SEVERAL = {"bspline-feed", "dwell several-tools", "fixture", "joint", "refine", "surface line"}
HEAD = '''"""Types of the stage functions, made by python/stubs.py."""

import os
from typing import Any, Literal, Mapping, Protocol, Sequence, Union

from . import Artifact

class _Labelled(Protocol):
    """An array of xarray."""

    @property
    def dims(self) -> Any: ...
    @property
    def coords(self) -> Any: ...

PathLike = Union[str, os.PathLike[str]]
# A map: the path of an artifact or of a file, an artifact, (map, x, y), or an array of xarray
MapLike = Union[PathLike, _Labelled, Sequence[Any]]
MachineLike = Union[PathLike, Mapping[str, Any]]
'''
ONE = {"number": "float", "integer": "int", "path": "PathLike"}


def argument(name):
    """Returns the argument of Python for a flag or a command."""
    name = name.replace("-", "_")
    return f"{name}_" if keyword.iskeyword(name) else name


def type_of(flag):
    """Returns the type of a flag's argument."""
    if flag["values"][1] == 0:
        return "bool"
    if flag["name"] in ("surface", "tif"):
        return "MapLike"
    if flag["name"] == "machine":
        return "MachineLike"
    one = ONE.get(flag.get("type"), "str")
    if flag["choices"]:
        one = f"Literal[{', '.join(json.dumps(choice) for choice in flag['choices'])}]"
    elif one == "str" and "," in (flag["value"] or ""):
        one = "str | Sequence[float]"
    if flag["values"][1] > 1:
        return f"Sequence[{one}] | Sequence[Sequence[{one}]]" if flag["repeats"] else f"Sequence[{one}]"
    return f"{one} | Sequence[{one}]" if flag["repeats"] else one


def returned(program, command):
    """Returns the type of what the function of a command returns."""
    out = next((flag for flag in command["flags"] if flag["name"] == "out"), None)
    if out is None or out["value"] != "DIR":
        return "str"
    name = f"{program} {command['name']}".strip()
    return "dict[str, Artifact]" if name in SEVERAL else "Artifact"


def function(program, command):
    """Returns the lines of the function of a command."""
    flags = [flag for flag in command["flags"] if flag["name"] not in ("help", "version")]
    words = ["self"] + [f"*{argument(flag['name'])}: Any" for flag in flags if flag["positional"]][:1]
    named = [flag for flag in flags if not flag["positional"]]
    if named and len(words) == 1:
        words.append("*")
    for flag in sorted(named, key=lambda flag: not flag["required"] or flag["name"] == "out"):
        kind, key = type_of(flag), argument(flag["name"])
        required = flag["required"] and not (key == "out" and flag["value"] == "DIR")
        words.append(f"{key}: {kind}" if required else f"{key}: {kind} | None = None")
    name = argument(command["name"]) if command["name"] else "__call__"
    text = f"def {name}(\n" + "".join(f"    {word},\n" for word in words) + f") -> {returned(program, command)}:\n"
    lines = [*paragraphs(command["about"]), "", "Parameters", "----------"]
    for flag in named:
        default = f", default {flag['default']}" if flag["default"] else "" if flag["required"] else ", optional"
        kind = type_of(flag).replace("PathLike", "path").replace("MapLike", "map").replace("MachineLike", "machine")
        lines.append(f"{argument(flag['name'])} : {kind}{default}")
        lines += textwrap.wrap(" ".join(flag["help"].split()), 108, initial_indent="    ", subsequent_indent="    ")
    body = "\n".join(lines).replace("\\", "\\\\").replace('"""', "'''")
    return text + textwrap.indent(f'"""{body}\n"""\n...\n', "    ")


def paragraphs(text):
    """Returns the lines of a description, wrapped."""
    parts = [textwrap.wrap(" ".join(part.split()), 108) for part in text.strip().split("\n\n")]
    return [line for part in parts for line in [*part, ""]][:-1]


def stubs(program):
    """Returns the stub of all stages that the file `program` holds."""
    crates = pathlib.Path(__file__).resolve().parents[1] / "crates"
    text = HEAD
    for name in sorted(main.parents[1].name for main in crates.glob("*/src/command.rs")):
        ran = subprocess.run([program, f"planish-{name}", "--describe"], check=True, capture_output=True)
        described = json.loads(ran.stdout)
        title = "_" + re.sub(r"(?:^|-)(\w)", lambda letter: letter[1].upper(), name)
        functions = "\n".join(function(name, command) for command in described["commands"])
        about = " ".join(described["about"].split())
        text += f"\nclass {title}:\n" + textwrap.indent(f'"""{about}"""\n\n{functions}', "    ")
        text += f"\n{argument(name)}: {title}\n"
    return text


if __name__ == "__main__":
    print(stubs(sys.argv[1]), end="")

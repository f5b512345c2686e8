"""Runs docs/notebook.ipynb as a user does, and types what it ran into a shell: are the bytes the same?

    environment/bin/python try_notebook.py NOTEBOOK EXECUTED     in an empty directory

Needs Planish, nbclient, ipykernel and matplotlib in the environment. EXECUTED is the notebook with its pictures, and
nothing in it of the machine that made it. Ends with an error if NOTEBOOK shows other texts than EXECUTED; its pictures
are not compared, because they depend on the version of Matplotlib.
"""

import json
import os
import pathlib
import re
import shutil
import subprocess
import sys

import nbclient
import nbformat
import planish

from try_wheel import digests


# Largest relative difference of a number that the notebook shows from the one of this run: another processor rounds
# another way, and a solver then ends elsewhere within its tolerance. That of `just test-commands`, for the same reason.
OTHER_PROCESSOR = 1e-2
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")


def texts(notebook):
    """What the cells print, cell by cell. Hashes differ with the last bit of a number, and are left out."""
    printed = ["".join(o.get("text", "") for o in c.get("outputs", [])) for c in notebook.cells]
    return [re.sub(r"\b[0-9a-f]{64}\b|crc32 [0-9a-f]{8}", "HASH", text) for text in printed]


def is_alike(shown, printed):
    """Returns true if two texts have the same words, and numbers that differ no more than by the processor."""
    if NUMBER.sub("#", shown) != NUMBER.sub("#", printed):
        return False
    numbers = zip(*([float(n) for n in NUMBER.findall(text)] for text in (shown, printed)))
    return all(abs(a - b) <= OTHER_PROCESSOR * abs(a) for a, b in numbers)


def execute(notebook):
    """The notebook with its outputs, without what differs from machine to machine."""
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    for cell in notebook.cells:
        cell.metadata.clear()
        for output in cell.get("outputs", []):
            output.get("metadata", {}).clear()
            if "text" in output:
                # A warning begins with the file of its cell, which has the number of the process.
                output["text"] = re.sub(r"\S*/ipykernel_\d+/\d+\.py:\d+: ", "", output["text"])
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    return notebook


def commands(folder):
    """What the manifests in the folder say that was typed, in the order of the runs, each once."""
    found = {}
    for manifest in sorted(pathlib.Path(folder).rglob("manifest.json"), key=lambda m: m.stat().st_mtime_ns):
        command = json.loads(manifest.read_text("utf-8"))["command"]
        found.setdefault(command, None)
    return list(found)


def main(source, executed):
    pathlib.Path("notebook").mkdir()
    os.chdir("notebook")
    shown = texts(nbformat.read(source, as_version=4))
    notebook = execute(nbformat.read(source, as_version=4))
    os.chdir("..")
    pictures = [o for c in notebook.cells for o in c.get("outputs", []) if "image/png" in o.get("data", {})]
    assert len(pictures) == 2, len(pictures)
    said = [o.get("text", "") + str({**o.get("data", {}), "image/png": ""})
            for c in notebook.cells for o in c.get("outputs", [])]
    for word in (str(pathlib.Path.cwd()), str(pathlib.Path.home()), os.uname().nodename, planish.programs()):
        assert word == "/" or not any(str(word) in text for text in said), word
    pathlib.Path(executed).write_text(nbformat.writes(notebook), "utf-8")

    # The same by the command line, in a folder of its own with the same inputs.
    shutil.copytree("notebook", "typed", ignore=lambda _, names: set(names) - {"mirror", "tool", "machine.json"}
                    if "mirror" in names else set())
    ran = commands("notebook")
    ran += [f"planish export {c} --trajectory=plan/trajectory --machine=machine.json --out={o}"
            for c, o in (("galil", "program.galil"), ("gcode", "program.ngc"))]
    environment = {**os.environ, "PATH": f"{planish.programs()}{os.pathsep}{os.environ['PATH']}"}
    for command in ran:
        subprocess.run(command, shell=True, cwd="typed", env=environment, check=True, capture_output=True)
    first, second = digests("notebook"), digests("typed")
    assert first == second, {name for name in first.keys() | second.keys() if first.get(name) != second.get(name)}
    stale = [f"{a}\n-- is now --\n{b}" for a, b in zip(shown, texts(notebook)) if not is_alike(a, b)]
    assert not stale, "docs/notebook.ipynb shows other texts; just notebook writes them anew:\n" + "\n".join(stale)
    print(f"notebook: {len(pictures)} pictures, {len(ran)} commands, {len(first)} files with the bytes of the command line")


if __name__ == "__main__":
    main(*map(os.path.abspath, sys.argv[1:3]))

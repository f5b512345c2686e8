#!/usr/bin/env python3
"""What is left of a sweep that is killed: `just test-sweep`.

The small sweep runs once to its end. Then it runs again elsewhere, and in the middle

* the workflow is killed (SIGKILL to Snakemake): its job and the stages of it must end with it or soon after;
* it is started anew, and a stage is killed: the job must try that plan once more, and go on.

At the end every file must be the same as that of the run that nobody disturbed, and no plan that was finished when the
workflow was killed may have been made again. A further run must find nothing to do. Linux; Python without packages.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SWEEP = "sweeps/small.yaml"
LIMIT_S = 300
# What says how a run went, not what came of it.
HOW = {"done", "lock", ".snakemake"}


def start(out):
    return subprocess.Popen(["workflow/sweep.sh", SWEEP, f"out={out}"], cwd=ROOT, start_new_session=True,
                            stdout=open(f"{out}.log", "a"), stderr=subprocess.STDOUT)


def parents():
    """The number of the parent, and the name, of every process."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                name, rest = (entry / "stat").read_text().split(" (", 1)[1].rsplit(") ", 1)
            except (OSError, IndexError):
                continue
            found[int(entry.name)] = (int(rest.split()[1]), name)
    return found


def below(pid):
    """The processes that a process has started, and those that these have, with their names."""
    found, all_of_them = {}, parents()
    wanted = [pid]
    while wanted:
        parent = wanted.pop()
        for child, (its_parent, name) in all_of_them.items():
            if its_parent == parent:
                found[child] = name
                wanted.append(child)
    return found


def wait_for(what, found):
    begun = time.monotonic()
    while time.monotonic() - begun < LIMIT_S:
        value = found()
        if value:
            return value
        time.sleep(0.01)
    sys.exit(f"failed: {what} does not come")


def ended(process, what):
    code = process.wait(LIMIT_S)
    if code != 0:
        sys.exit(f"failed: {what} ended with {code}; {process.args[-1]}.log says why")


def files(folder):
    """Every file that is a result: its bytes."""
    found = {}
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        if relative.parts[0] not in HOW and path.is_file() and not path.is_symlink():
            found[relative] = path.read_bytes()
    return found


def times(folder):
    return {path: path.stat().st_mtime_ns for path in folder.glob("plans/*/row.json")}


def main():
    at = ROOT / "out" / "test-sweep"
    subprocess.run(["rm", "-rf", at], check=True)
    at.mkdir(parents=True)
    whole, killed = at / "whole", at / "killed"
    begun = time.monotonic()
    ended(start(whole), "the run that nobody disturbs")
    undisturbed_s = time.monotonic() - begun

    first = start(killed)
    wait_for("the second row", lambda: len(times(killed)) >= 2)
    there = times(killed)
    tree = below(first.pid)
    job = [pid for pid, name in tree.items() if name == "planish-sweep"]
    for pid, name in tree.items():
        if name.startswith(("snakemake", "python")):
            os.kill(pid, signal.SIGKILL)
    first.wait(LIMIT_S)
    wait_for("the end of the job", lambda: not any(os.path.exists(f"/proc/{pid}/exe") for pid in job))
    made_before = len(there)

    second = start(killed)
    stages = ("planish-joint", "planish-refine", "planish-toleran")  # the system keeps 15 letters of a name
    stage = wait_for("a stage", lambda: [p for p, n in below(second.pid).items() if n in stages])
    os.kill(stage[0], signal.SIGKILL)
    ended(second, "the run after the kill")
    again = [path for path, when in there.items() if path.stat().st_mtime_ns != when]
    if again:
        sys.exit(f"failed: made again: {again}")
    said = (at / "killed.log").read_text()
    if "it is tried once more, alone" not in said:
        sys.exit("failed: nobody noticed the killed stage")

    a, b = files(whole), files(killed)
    differ = [str(name) for name in a.keys() | b.keys() if a.get(name) != b.get(name)]
    if differ:
        sys.exit(f"failed: not the same: {differ[:10]}")
    before = times(killed)
    ended(start(killed), "the run with nothing to do")
    if times(killed) != before:
        sys.exit("failed: a run with nothing to do has made rows")
    print(f"{len(before)} plans in {undisturbed_s:.1f} s; killed when {made_before} were made, and a stage killed: "
          f"none of them made again, {len(a)} files the same")


if __name__ == "__main__":
    main()

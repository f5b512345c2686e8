#!/usr/bin/env python3
"""Times of every pipeline with its defaults, and of the commands of every tutorial, as a table.

times-table.py [--out DIR] [NAME...]

A name is a pipeline or a tutorial, such as `raster` or `disk-on-spindle`; all of them without one. Each row has the wall
time, the CPU time of all processes, and the CPU time over two cores, which a quiet machine with two cores needs at least.
The exit code is 1 if one of these ends with a refusal, or takes more than 3 minutes of CPU time on each of two cores.
DIR is out/times by default.
"""

import argparse
import pathlib
import re
import resource
import subprocess
import sys
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
# Largest CPU time, s, over the number of cores that it is meant for.
MOST_S = 180.0
CORES = 2


def commands(page):
    """The commands in the blocks of a page that are marked sh."""
    blocks = re.findall(r"^```sh\n(.*?)^```", page, re.M | re.S)
    return "".join(blocks)


def cpu_s():
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("names", nargs="*")
    arguments.add_argument("--out", type=pathlib.Path, default=ROOT / "out/times")
    given = arguments.parse_args()
    out = given.out.resolve()
    rows = {}
    for file in sorted((ROOT / "pipelines").glob("*.yaml")):
        if file.stem != "shared":
            rows[file.stem] = f"planish-run run {file.stem} out='{out}/{file.stem}'"
    for file in sorted((ROOT / "docs/tutorials").glob("*.md")):
        text = commands(file.read_text("utf-8")).replace("just run ", "planish-run run ").replace("just next", "planish-run next")
        if text and "mirror.datx" not in text:
            rows[file.stem] = text
    if unknown := set(given.names) - set(rows):
        sys.exit(f"{', '.join(sorted(unknown))}: give {', '.join(rows)}")
    print(f"{'what':<28} {'wall, s':>8} {'CPU, s':>8} {f'CPU / {CORES}, s':>11}  exit code")
    is_good = True
    for name in given.names or rows:
        out.mkdir(parents=True, exist_ok=True)
        used, begun = cpu_s(), time.monotonic()
        with (out / f"{name}.log").open("w") as log:
            script = f"PATH='{ROOT}/target/release':$PATH PLANISH_SHARE='{ROOT}'; export PATH PLANISH_SHARE; set -e\n{rows[name]}"
            code = subprocess.run(["sh", "-c", script], cwd=ROOT, stdout=log, stderr=subprocess.STDOUT).returncode
        wall_s, used_s = time.monotonic() - begun, cpu_s() - used
        is_good &= code in (0, 1) and used_s <= CORES * MOST_S
        print(f"{name:<28} {wall_s:>8.1f} {used_s:>8.1f} {used_s / CORES:>11.1f}  {code}", flush=True)
    sys.exit(0 if is_good else 1)


if __name__ == "__main__":
    main()
